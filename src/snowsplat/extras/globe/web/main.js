// The page: camera, input, and the pace of the simulation. A worker (simulation.js) moves the
// Gaussians, and renderer.js draws them.
"use strict";

const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

// ---- Camera

// Orbit of the globe, as in snowsplat/extras/globe/globe_video.py. Rows of `axes`: right, down, forward.
function orbit(azimuth, elevation, distance) {
    const ce = Math.cos(elevation),
        se = Math.sin(elevation);
    const ca = Math.cos(azimuth),
        sa = Math.sin(azimuth);
    return {
        position: [distance * ce * sa, C.MIDDLE - distance * se, -distance * ce * ca],
        axes: [
            [ca, 0, sa],
            [se * sa, ce, -se * ca],
            [-ce * sa, se, ce * ca],
        ],
    };
}

// ---- The globe

const SWING = Math.PI / 6; // the scene turns by this angle to each side if its back is unknown
const TURN_SECONDS = 60;
const SLOW = 1000 / 30; // milliseconds per frame
const LEAST_COUNT = 10000,
    LEAST_RATIO = 0.6;

class Globe {
    constructor() {
        this.canvas = element("view");
        const columns = decode();
        this.count = about.count; // of the Gaussians that are displayed
        this.renderer = new Renderer(this.canvas, columns, this.count);
        const code = new Blob([about.simulation], { type: "text/javascript" });
        this.worker = new Worker(URL.createObjectURL(code));
        this.worker.onmessage = ({ data }) => this.receive(data);
        this.worker.postMessage({ home: columns.position, constants: C });
        this.buffers = {
            state: new Float32Array(4 * STATE_WIDTH * this.renderer.rows),
            order: new Uint32Array(this.count),
        };
        this.result = { standing: true, remembering: null, milliseconds: 0 };
        this.owed = 0; // seconds that have passed, but are not yet simulated
        this.azimuth = 0;
        this.elevation = C.ELEVATION;
        this.zoom = 1;
        this.seconds = 0; // since the page was opened, for the turning of the scene
        this.turned = 0; // azimuth of the scene in the globe
        this.shaken = Infinity; // seconds since the button was pressed
        this.push = [0, 0, 0]; // acceleration by the pointer or the phone, in the camera's frame
        this.pixelRatio = Math.min(devicePixelRatio || 1, 2);
        this.adapts = true;
        this.intervals = [];
        this.waiting = null;
        this.listen();
        this.request([], true);
        requestAnimationFrame(now => this.frame(now));
    }

    // ---- Simulation

    cameras() {
        const globe = orbit(this.azimuth, this.elevation, C.DISTANCE);
        return { globe, scene: orbit(this.azimuth + this.turned, this.elevation, C.DISTANCE) };
    }

    // Ask the worker for the state after these steps. One request is under way at a time.
    request(steps, force) {
        const forward = this.cameras().scene.axes[2];
        const key = `${forward.map(f => f.toFixed(3))} ${this.count}`;
        const rests = this.result.standing && !steps.some(([, a]) => Math.hypot(...a) > 0);
        if (!this.buffers || (!force && rests && key === this.sorted)) return false;
        this.sorted = key;
        const { state, order } = this.buffers;
        this.buffers = null;
        this.worker.postMessage({ steps, forward, count: this.count, remember: this.remembers, state, order }, [
            state.buffer,
            order.buffer,
        ]);
        this.remembers = false;
        return true;
    }

    receive(result) {
        this.result = result;
        this.renderer.update(result);
        this.buffers = { state: result.state, order: result.order };
        element("remember").disabled = result.standing || result.remembering !== null;
        this.drawn = false;
        if (this.waiting) this.waiting();
        this.waiting = null;
    }

    // The acceleration of the globe in the frame of the scene, `seconds` from now.
    acceleration(seconds) {
        const since = this.shaken + seconds;
        let inCamera = this.push;
        if (since < C.SHAKE_SECONDS) {
            const strength =
                C.SHAKE_ACCELERATION *
                Math.sin((Math.PI * since) / C.SHAKE_SECONDS) *
                Math.sin(2 * Math.PI * C.SHAKE_FREQUENCY * since);
            inCamera = C.SHAKE_DIRECTION.map((share, i) => strength * share + this.push[i]);
        }
        const { axes } = this.cameras().scene;
        return [0, 1, 2].map(i => axes.reduce((sum, axis, j) => sum + axis[i] * inCamera[j], 0));
    }

    shake() {
        this.shaken = 0;
        this.remembers = false;
        this.hideHint();
    }

    remember() {
        this.remembers = true;
    }

    // Steps for this time, none of which is longer than the simulation allows.
    steps(seconds) {
        const number = Math.max(1, Math.ceil(seconds / C.LONGEST_STEP - 1e-6));
        return Array.from({ length: number }, (_, i) => [seconds / number, this.acceleration((i * seconds) / number)]);
    }

    // Advance at once, without drawing: for tests. The promise is fulfilled when it is done.
    async advance(seconds) {
        for (let left = seconds; left > 1e-6; left -= C.LONGEST_STEP) {
            while (!this.buffers) await new Promise(done => (this.waiting = done));
            const now = Math.min(left, C.LONGEST_STEP);
            const steps = this.steps(now);
            this.shaken += now;
            this.request(steps, true);
        }
        while (!this.buffers) await new Promise(done => (this.waiting = done));
    }

    // ---- Drawing

    frame(now) {
        requestAnimationFrame(next => this.frame(next));
        const interval = Math.min(now - (this.last ?? now), 250);
        this.last = now;
        if (this.paused || document.hidden) return;
        const seconds = interval / 1000;
        this.turn(seconds);
        if (this.result.standing) this.intervals.length = 0;
        else this.adapt(Math.max(interval, this.result.milliseconds));
        // A very slow computer shows the motion more slowly.
        this.owed = Math.min(this.owed + seconds, 3 * C.LONGEST_STEP);
        if (this.owed > 0 && this.buffers) {
            this.request(this.steps(this.owed), this.remembers);
            this.shaken += this.owed;
            this.push = this.push.map(a => a * Math.exp(-this.owed / 0.06));
            this.owed = 0;
        }
        this.draw();
    }

    turn(seconds) {
        if (reducedMotion.matches || this.dragging) return;
        this.seconds += seconds;
        const turns = (2 * Math.PI * this.seconds) / TURN_SECONDS;
        this.turned = about.surrounded ? turns : SWING * Math.sin(turns);
        this.drawn = false;
    }

    draw() {
        const { canvas, renderer } = this;
        const width = Math.max(1, Math.round(canvas.clientWidth * this.pixelRatio));
        const height = Math.max(1, Math.round(canvas.clientHeight * this.pixelRatio));
        if (this.drawn && canvas.width === width && canvas.height === height) return;
        renderer.resize(width, height);
        const focal = C.FOCAL * Math.min(width, 0.94 * height) * this.zoom;
        const centre = [0.5 * width, 0.47 * height];
        if (this.shaken < C.SHAKE_SECONDS && !reducedMotion.matches) {
            const strength =
                Math.sin((Math.PI * this.shaken) / C.SHAKE_SECONDS) *
                Math.sin(2 * Math.PI * C.SHAKE_FREQUENCY * this.shaken);
            const offset =
                (-C.SHAKE_ACCELERATION * strength * focal) / (2 * Math.PI * C.SHAKE_FREQUENCY) ** 2 / C.DISTANCE;
            centre[0] += offset * C.SHAKE_DIRECTION[0];
            centre[1] += offset * C.SHAKE_DIRECTION[1];
        }
        const { globe, scene } = this.cameras();
        renderer.draw(globe, scene, focal, centre);
        this.drawn = true;
    }

    // Below 30 frames a second: fewer pixels, then fewer Gaussians, the least important ones first.
    adapt(interval) {
        if (!this.adapts || interval <= 0) return;
        this.intervals.push(interval);
        if (this.intervals.length < 30) return;
        const middle = this.intervals.sort((a, b) => a - b)[15];
        this.intervals.length = 0;
        if (middle <= SLOW) return;
        if (this.pixelRatio > LEAST_RATIO && this.result.milliseconds < SLOW) {
            this.pixelRatio = Math.max(LEAST_RATIO, this.pixelRatio * 0.8);
        } else {
            const fewer = Math.round(this.count * 0.8);
            this.count = Math.min(this.count, Math.max(fewer, LEAST_COUNT));
        }
    }

    // ---- Input

    listen() {
        const { canvas } = this;
        let x = 0,
            y = 0,
            time = 0,
            vx = 0,
            vy = 0;
        canvas.addEventListener("pointerdown", event => {
            canvas.setPointerCapture(event.pointerId);
            [x, y, time] = [event.clientX, event.clientY, event.timeStamp];
            vx = vy = 0;
            this.dragging = true;
        });
        canvas.addEventListener("pointermove", event => {
            if (!this.dragging) return;
            const dx = event.clientX - x,
                dy = event.clientY - y;
            const seconds = Math.max((event.timeStamp - time) / 1000, 0.004);
            [x, y, time] = [event.clientX, event.clientY, event.timeStamp];
            this.rotate(-dx * 0.007, dy * 0.004);
            // Fast changes of direction shake the globe. Velocities are in radii per second.
            const radius = 0.36 * Math.min(canvas.clientWidth, canvas.clientHeight);
            const [wx, wy] = [dx / seconds / radius, dy / seconds / radius];
            const ax = (wx - vx) / Math.max(seconds, 0.016),
                ay = (wy - vy) / Math.max(seconds, 0.016);
            [vx, vy] = [wx, wy];
            if (Math.hypot(ax, ay) > 150) this.pushBy(0.12 * ax, 0.12 * ay, 0);
        });
        for (const end of ["pointerup", "pointercancel"]) {
            canvas.addEventListener(end, () => (this.dragging = false));
        }
        canvas.addEventListener(
            "wheel",
            event => {
                event.preventDefault();
                this.zoom = Math.min(2.5, Math.max(0.6, this.zoom * Math.exp(-0.001 * event.deltaY)));
                this.drawn = false;
            },
            { passive: false },
        );
        addEventListener("keydown", event => {
            const onButton = event.target instanceof HTMLButtonElement;
            if (event.key === " " && !onButton) this.shake();
            else if (event.key === "Enter" && !onButton) this.remember();
            else if (event.key === "ArrowLeft") this.rotate(0.1, 0);
            else if (event.key === "ArrowRight") this.rotate(-0.1, 0);
            else if (event.key === "ArrowUp") this.rotate(0, 0.06);
            else if (event.key === "ArrowDown") this.rotate(0, -0.06);
            else return;
            event.preventDefault();
        });
        element("shake").addEventListener("click", () => {
            this.shake();
            this.askForMotion();
        });
        element("remember").addEventListener("click", () => this.remember());
        this.listenToMotion();
    }

    rotate(azimuth, elevation) {
        this.azimuth += azimuth;
        this.elevation = Math.min(1.0, Math.max(0.0, this.elevation + elevation));
        this.drawn = false;
        this.hideHint();
    }

    pushBy(x, y, z) {
        const size = Math.hypot(x, y, z),
            most = C.SHAKE_ACCELERATION;
        this.push = [x, y, z].map(a => (a * Math.min(size, most)) / size);
    }

    // Safari asks the user for permission, after a click.
    askForMotion() {
        if (this.motion) return;
        this.motion = true;
        const ask = globalThis.DeviceMotionEvent?.requestPermission;
        if (!ask) return;
        ask.call(DeviceMotionEvent)
            .then(answer => answer === "granted" && this.listenToMotion())
            .catch(() => {}); // not allowed: the buttons are enough
    }

    listenToMotion() {
        this.onMotion ??= ({ acceleration }) => {
            const { x, y, z } = acceleration ?? {};
            // The axes of a phone are right, up, and towards the user.
            if (Math.hypot(x ?? 0, y ?? 0, z ?? 0) > 4) this.pushBy(1.5 * x, -1.5 * y, -1.5 * z);
        };
        removeEventListener("devicemotion", this.onMotion);
        addEventListener("devicemotion", this.onMotion);
    }

    hideHint() {
        element("hint").style.opacity = 0;
    }
}

// The texts of the page in Chinese, for a browser in Chinese.
const chinese = navigator.language.toLowerCase().startsWith("zh");
if (chinese) {
    document.documentElement.lang = "zh-CN";
    document.title = element("title").textContent = `${about.name} - 雪花球`;
    element("view").setAttribute("aria-label", `雪花球中的场景：${about.name}`);
    element("hint").textContent = "拖动可以转动雪花球，快速拖动可以摇晃它；在手机上，也可以摇晃手机。";
    for (const [id, text, title] of [
        ["shake", "摇晃", "空格键"],
        ["remember", "复原", "回车键"],
    ]) {
        Object.assign(element(id), { textContent: text, title });
    }
}

try {
    window.snowGlobe = new Globe();
} catch (error) {
    const line = document.createElement("p");
    line.textContent = chinese ? "这个网页需要支持 WebGL 2 的浏览器。" : "This page needs a browser with WebGL 2.";
    document.body.append(line);
    throw error;
}
