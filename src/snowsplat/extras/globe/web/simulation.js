// The motion of the Gaussians: the same equations as in snowsplat/extras/globe/physics.py, which explains
// them. A worker runs it, and sorts the Gaussians by depth, so that the page stays responsive.
"use strict";

function randomNumbers(count, channel) {
    const numbers = new Float64Array(count);
    for (let i = 0; i < count; i++) {
        let x = (Math.imul(i, 16) + channel) >>> 0;
        for (const factor of [0x7feb352d, 0x846ca68b]) {
            x ^= x >>> 16;
            x = Math.imul(x, factor) >>> 0;
        }
        x = (x ^ (x >>> 16)) >>> 0;
        numbers[i] = x / 4294967296;
    }
    return numbers;
}

const inRange = (limits, shares) => Float32Array.from(shares, share => limits[0] + (limits[1] - limits[0]) * share);

class Snow {
    // home: Float32Array, x y z of each Gaussian; C: the constants of physics.py.
    constructor(home, C) {
        const count = home.length / 3;
        this.C = C;
        this.home = home;
        this.count = count; // the first ones of this number move and are displayed
        this.position = home.slice();
        this.velocity = new Float32Array(3 * count);
        this.angle = new Float32Array(count);
        this.morph = new Float32Array(count);
        this.resting = new Uint8Array(count);
        this.loosening = 0;
        this.strength = 0;
        this.time = 0;
        this.remembering = null;
        const random = Array.from({ length: 9 }, (_, i) => randomNumbers(count, i));
        const level = i => Math.min(1, Math.max(0, (C.FLOOR - home[3 * i + 1]) / (C.FLOOR + C.WALL)));
        this.hold = inRange(
            C.HOLD,
            random[0].map((r, i) => 0.55 * r + 0.45 * (1 - level(i))),
        );
        this.turn = Float32Array.from(random[1], r => (r < 0.5 ? -C.SPIN : C.SPIN));
        this.drag = inRange(C.DRAG, random[2]);
        this.fall = inRange(C.FALL, random[3]);
        this.start = Float32Array.from(random[4], (r, i) => C.STARTS * (0.35 * r + 0.65 * level(i)));
        this.lift = inRange(C.LIFT, random[5]);
        this.rate = inRange(C.CIRCLE_RATE, random[6]);
        this.phase = inRange([0, 2 * Math.PI], random[7]);
        this.launch = inRange(C.LAUNCH, random[8]);
        this.grid = new Float32Array(3 * C.FLOW_CELLS ** 3);
        this.waves = Float64Array.from(C.WAVE.flat());
        const cells = Math.sqrt((count * 4) / Math.PI / C.FLAKES_PER_CELL);
        this.cells = Math.trunc(Math.min(Math.max(cells, C.PILE_CELLS[0]), C.PILE_CELLS[1]));
        this.perUnit = this.cells / (2 * C.FLOOR_RADIUS);
        this.pile = new Float32Array(this.cells ** 2);
    }

    get standing() {
        return this.loosening <= this.C.HOLD[0];
    }

    remember() {
        if (!this.standing && this.remembering === null) this.remembering = 0;
    }

    step(seconds, acceleration) {
        const { C } = this;
        const strong = Math.hypot(...acceleration);
        const pushed = strong * seconds;
        const decay = Math.exp(-seconds / C.DECAY);
        this.strength = Math.min(C.STRONGEST, this.strength * decay + C.STIR * pushed);
        this.loosening += C.LOOSEN * pushed;
        this.time += seconds;
        if (this.standing) {
            this.loosening *= decay;
            return;
        }
        if (strong > C.INTERRUPTS) this.remembering = null;
        this.fallStep(seconds, acceleration);
        if (this.remembering === null) return;
        this.flyStep(seconds);
        this.remembering += seconds;
        if (this.remembering > C.REMEMBER_SECONDS) this.stand();
    }

    stand() {
        this.position.set(this.home);
        for (const values of [this.velocity, this.angle, this.morph, this.resting]) values.fill(0);
        this.loosening = 0;
        this.remembering = null;
    }

    // The flow of strength 1 on the grid.
    updateFlow() {
        const { C, grid, waves } = this;
        const n = C.FLOW_CELLS,
            cells = n ** 3;
        for (let i = 0; i < cells; i++) {
            const x = ((i % n) * 2) / (n - 1) - 1;
            const y = ((((i / n) | 0) % n) * 2) / (n - 1) - 1;
            const z = (((i / (n * n)) | 0) * 2) / (n - 1) - 1;
            let px = -C.RING * z,
                py = 0,
                pz = C.RING * x;
            let cx = 0,
                cy = -2 * C.RING,
                cz = 0;
            for (let wave = 0; wave < waves.length; wave += 8) {
                const kx = waves[wave],
                    ky = waves[wave + 1],
                    kz = waves[wave + 2];
                const ax = waves[wave + 3],
                    ay = waves[wave + 4],
                    az = waves[wave + 5];
                const now = waves[wave + 6] * this.time + waves[wave + 7];
                const angle = kx * x + ky * y + kz * z + now;
                const sin = Math.sin(angle),
                    cos = Math.cos(angle);
                px += sin * ax;
                py += sin * ay;
                pz += sin * az;
                cx += cos * (ky * az - kz * ay);
                cy += cos * (kz * ax - kx * az);
                cz += cos * (kx * ay - ky * ax);
            }
            const glass = Math.max(1 - (x * x + y * y + z * z), 0);
            const floor = Math.max(C.FLOOR - y, 0);
            const b = glass * floor;
            const bx = b > 0 ? -2 * x * floor : 0;
            const by = b > 0 ? -2 * y * floor - glass : 0;
            const bz = b > 0 ? -2 * z * floor : 0;
            grid[i] = by * pz - bz * py + b * cx - C.VORTEX * z;
            grid[cells + i] = bz * px - bx * pz + b * cy;
            grid[2 * cells + i] = bx * py - by * px + b * cz + C.VORTEX * x;
        }
    }

    cell(coordinate) {
        const cell = Math.trunc((coordinate + this.C.FLOOR_RADIUS) * this.perUnit);
        return Math.min(this.cells - 1, Math.max(0, cell));
    }

    updatePile() {
        const { C, pile, position } = this;
        const height = (C.PILE_DEPTH * Math.PI * (this.cells / 2) ** 2) / this.count;
        pile.fill(0);
        for (let i = 0; i < this.count; i++) {
            if (!this.resting[i]) continue;
            const x = this.cell(position[3 * i]),
                z = this.cell(position[3 * i + 2]);
            pile[z * this.cells + x] += height;
        }
        for (let i = 0; i < pile.length; i++) pile[i] = Math.min(pile[i], C.HIGHEST);
    }

    fallStep(seconds, acceleration) {
        const { C, position, velocity, grid, pile } = this;
        const n = C.FLOW_CELLS,
            cells = n ** 3,
            half = (n - 1) / 2,
            last = n - 1.001;
        const strength = this.strength;
        for (let i = 0; i < this.count; i++) if (strength > this.lift[i]) this.resting[i] = 0;
        this.updateFlow();
        this.updatePile();
        const { perUnit, cells: pileCells } = this,
            lastCell = pileCells - 1.001;
        const atGlass = (C.FLOOR_RADIUS - 1 / perUnit) ** 2;
        const push = C.SHARE * seconds;
        const circling = C.CIRCLE[0] + C.CIRCLE[1] * strength;
        const morphs = 1 - Math.exp(-seconds / C.MORPH);
        const clamp = (value, most) => Math.min(Math.max(value, 0), most);
        for (let i = 0; i < this.count; i++) {
            if (this.resting[i] || this.loosening <= this.hold[i]) continue;
            if (this.remembering !== null && this.remembering >= this.start[i]) continue;
            let x = position[3 * i],
                y = position[3 * i + 1],
                z = position[3 * i + 2];

            // The flow, interpolated.
            const gx = clamp((x + 1) * half, last),
                gy = clamp((y + 1) * half, last);
            const gz = clamp((z + 1) * half, last);
            const ix = gx | 0,
                iy = gy | 0,
                iz = gz | 0;
            const fx = gx - ix,
                fy = gy - iy,
                fz = gz - iz;
            let ux = 0,
                uy = 0,
                uz = 0;
            for (let corner = 0; corner < 8; corner++) {
                const dx = corner & 1,
                    dy = (corner >> 1) & 1,
                    dz = corner >> 2;
                const weight = (dx ? fx : 1 - fx) * (dy ? fy : 1 - fy) * (dz ? fz : 1 - fz);
                const at = ((iz + dz) * n + iy + dy) * n + ix + dx;
                ux += weight * grid[at];
                uy += weight * grid[cells + at];
                uz += weight * grid[2 * cells + at];
            }
            const angle = this.phase[i] + this.rate[i] * (this.time % 1000);
            const sin = Math.sin(angle),
                cos = Math.cos(angle);
            ux = strength * ux + circling * cos;
            uy = strength * uy + this.fall[i] - circling * 2 * sin * cos;
            uz = strength * uz + circling * sin;

            const share = 1 - Math.exp(-seconds * this.drag[i]);
            let vx = velocity[3 * i],
                vy = velocity[3 * i + 1],
                vz = velocity[3 * i + 2];
            vx += (ux - vx) * share - acceleration[0] * push;
            vy += (uy - vy) * share - acceleration[1] * push;
            vz += (uz - vz) * share - acceleration[2] * push;
            x += vx * seconds;
            y += vy * seconds;
            z += vz * seconds;

            // The pile, interpolated: its height, and its slopes.
            const px = clamp((x + C.FLOOR_RADIUS) * perUnit - 0.5, lastCell);
            const pz = clamp((z + C.FLOOR_RADIUS) * perUnit - 0.5, lastCell);
            const jx = px | 0,
                jz = pz | 0,
                qx = px - jx,
                qz = pz - jz;
            const at = jz * pileCells + jx;
            const a = pile[at],
                b = pile[at + 1];
            const c = pile[at + pileCells],
                d = pile[at + pileCells + 1];
            const low = a + (b - a) * qx,
                high = c + (d - c) * qx;
            const ground = C.FLOOR - (low + (high - low) * qz);
            if (y > ground) {
                y = ground;
                const slopeX = ((b - a) * (1 - qz) + (d - c) * qz) * perUnit;
                const slopeZ = (high - low) * perUnit;
                if (strength > this.lift[i]) {
                    vy = -C.HOP * strength * (0.5 + this.lift[i]);
                } else if (slopeX * slopeX + slopeZ * slopeZ > C.REPOSE * C.REPOSE && x * x + z * z < atGlass) {
                    vx = -C.SLIDE * slopeX;
                    vy = 0;
                    vz = -C.SLIDE * slopeZ;
                } else {
                    vx = vy = vz = 0;
                    this.resting[i] = 1;
                }
            }
            position[3 * i] = x;
            position[3 * i + 1] = y;
            position[3 * i + 2] = z;
            velocity[3 * i] = vx;
            velocity[3 * i + 1] = vy;
            velocity[3 * i + 2] = vz;
            this.collideWithGlass(i);
            vx = velocity[3 * i];
            vy = velocity[3 * i + 1];
            vz = velocity[3 * i + 2];
            const speed = Math.sqrt(vx * vx + vy * vy + vz * vz);
            this.angle[i] += this.turn[i] * speed * seconds;
            this.morph[i] += (1 - this.morph[i]) * morphs;
        }
    }

    collideWithGlass(i) {
        const { C, position, velocity } = this;
        const x = position[3 * i],
            y = position[3 * i + 1],
            z = position[3 * i + 2];
        const square = x * x + y * y + z * z;
        if (square <= C.WALL * C.WALL) return;
        const distance = Math.sqrt(square);
        const nx = x / distance,
            ny = y / distance,
            nz = z / distance;
        const outward = velocity[3 * i] * nx + velocity[3 * i + 1] * ny + velocity[3 * i + 2] * nz;
        const change = Math.max(outward, 0) * (1 + C.BOUNCE);
        position[3 * i] = nx * C.WALL;
        position[3 * i + 1] = ny * C.WALL;
        position[3 * i + 2] = nz * C.WALL;
        velocity[3 * i] -= nx * change;
        velocity[3 * i + 1] -= ny * change;
        velocity[3 * i + 2] -= nz * change;
    }

    flyStep(seconds) {
        const { C, position, velocity, home } = this;
        for (let i = 0; i < this.count; i++) {
            const since = this.remembering - this.start[i];
            if (since < 0 || this.loosening <= this.hold[i]) continue;
            if (since < seconds) {
                this.resting[i] = 0;
                velocity[3 * i] -= C.LAUNCH_VORTEX * position[3 * i + 2];
                velocity[3 * i + 1] -= this.launch[i];
                velocity[3 * i + 2] += C.LAUNCH_VORTEX * position[3 * i];
                this.angle[i] -= 2 * Math.PI * Math.round(this.angle[i] / (2 * Math.PI));
            }
            const left = Math.max(C.FLIGHT - since, seconds),
                s = seconds / left;
            for (let axis = 3 * i; axis < 3 * i + 3; axis++) {
                const way = home[axis] - position[axis],
                    v = velocity[axis];
                position[axis] += way * s * s * (3 - 2 * s) + v * left * s * (1 - s) ** 2;
                velocity[axis] = (way * 6 * s * (1 - s)) / left + v * (1 - s) * (1 - 3 * s);
            }
            this.collideWithGlass(i);
            if (s >= 1) {
                for (let axis = 3 * i; axis < 3 * i + 3; axis++) {
                    position[axis] = home[axis];
                    velocity[axis] = 0;
                }
            }
            this.angle[i] *= (1 - s) ** 2;
            this.morph[i] *= 1 - s;
        }
    }

    // Write x, y, z and the packed angle and morph of each Gaussian.
    pack(state) {
        const { position } = this;
        for (let i = 0; i < this.count; i++) {
            const turns = this.angle[i] / (2 * Math.PI);
            state[4 * i] = position[3 * i];
            state[4 * i + 1] = position[3 * i + 1];
            state[4 * i + 2] = position[3 * i + 2];
            // The integer part is the angle, in 1/4096 of a turn.
            state[4 * i + 3] = Math.floor((turns - Math.floor(turns)) * 4095.99) + 0.999 * this.morph[i];
        }
    }

    // Indices from back to front along `forward`, by counting.
    sort(forward, order) {
        const { position, count } = this;
        const [fx, fy, fz] = forward;
        const keys = (this.keys ??= new Uint16Array(position.length / 3));
        const starts = (this.starts ??= new Uint32Array(65537));
        starts.fill(0);
        for (let i = 0; i < count; i++) {
            const depth = fx * position[3 * i] + fy * position[3 * i + 1] + fz * position[3 * i + 2];
            const key = Math.min(65535, Math.max(0, (1 - depth) * 32767)) | 0;
            keys[i] = key;
            starts[key + 1]++;
        }
        for (let key = 0; key < 65536; key++) starts[key + 1] += starts[key];
        for (let i = 0; i < count; i++) order[starts[keys[i]]++] = i;
    }
}

// Each message requests the state after some steps: {steps: [[seconds, acceleration], …], forward,
// count, remember, state, order}. The buffers travel back and forth.
function serve(scope) {
    let snow = null;
    scope.onmessage = ({ data }) => {
        if (data.home) {
            snow = new Snow(data.home, data.constants);
            return;
        }
        const started = performance.now();
        snow.count = data.count;
        if (data.remember) snow.remember();
        for (const [seconds, acceleration] of data.steps) snow.step(seconds, acceleration);
        snow.pack(data.state);
        snow.sort(data.forward, data.order);
        const { standing, remembering, time } = snow;
        scope.postMessage(
            {
                state: data.state,
                order: data.order,
                count: data.count,
                milliseconds: performance.now() - started,
                standing,
                remembering,
                time,
            },
            [data.state.buffer, data.order.buffer],
        );
    };
}

// The page itself also includes this file, for the random numbers.
if (typeof WorkerGlobalScope !== "undefined") serve(self);
