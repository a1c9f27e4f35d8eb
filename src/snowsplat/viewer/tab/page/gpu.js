// A device of WebGPU, and the kernels in `native/wgsl`. What a kernel binds is read from its text; the
// kernels of each operation are listed in `plan.json`.

/** @typedef {any} Buffer of WebGPU */
/** @typedef {Record<string, any>} Values buffers and numbers by the names of variables in WGSL */
/**
 * @typedef {object} Step of an operation
 * @property {string} file
 * @property {string} entry
 * @property {string[]} [of]
 * @property {number} [plus]
 * @property {number} [items]
 * @property {number} [groups]
 * @property {number} [over]
 * @property {string} [needs]
 * @property {Record<string, string | number>} [set]
 * @property {Record<string, string>} [bind]
 */
/** @typedef {{of?: string[], plus?: number, items?: number, bytes: number}} Scratch memory of an operation */
/** @typedef {Record<string, {scratch?: Record<string, Scratch>, steps: Step[]}>} Plan */
/** @typedef {{bindings: [string, number][], uniform: number, numbers: [string, string][], pipeline: any}} Kernel */

const VARIABLE = /@group\(0\)\s*@binding\((\d+)\)\s*var<(uniform|storage[^>]*)>\s*(\w+)\s*:/g;
const FUNCTION = /((?:@compute\s*@workgroup_size\([^)]*\)\s*)?)fn\s+(\w+)\s*\(/g;
const ALIGNMENT = 256; // of a binding in its buffer, bytes
const UNIFORMS = 1 << 18; // bytes for the numbers of the kernels of a command buffer
const MOST_GROUPS = 65535; // in a dimension
const GROWTH = 1.25;

/** All words of a function and of those that it calls. @param {string} start @param {Map<string, Set<string>>} words */
const wordsOf = (start, words) => {
    const found = new Set();
    const todo = [start];
    for (let each = todo.pop(); each !== undefined; each = todo.pop())
        for (const word of words.get(each) ?? [])
            if (!found.has(word)) {
                found.add(word);
                if (words.has(word)) todo.push(word);
            }
    return found;
};

export class Gpu {
    /**
     * The device of this browser; null: there is none.
     * @param {Record<string, string>} shaders the texts in WGSL, by name
     * @param {Plan} plan
     */
    static async open(shaders, plan) {
        const gpu = /** @type {any} */ (navigator).gpu;
        const adapter = await gpu?.requestAdapter({ powerPreference: "high-performance" });
        if (!adapter) return null;
        const wanted = ["maxBufferSize", "maxStorageBufferBindingSize"];
        const requiredLimits = Object.fromEntries(wanted.map(name => [name, adapter.limits[name]]));
        return new Gpu(await adapter.requestDevice({ requiredLimits }), shaders, plan);
    }

    /** @param {any} device @param {Record<string, string>} shaders @param {Plan} plan */
    constructor(device, shaders, plan) {
        this.device = device;
        this.shaders = shaders;
        this.plan = plan;
        /** Bytes of a binding, at most. @type {number} */
        this.largest = device.limits.maxStorageBufferBindingSize;
        /** @type {Map<string, Kernel>} */
        this.kernels = new Map();
        /** @type {Map<string, Buffer>} memory that operations share, by name */
        this.scratch = new Map();
        /** @type {Map<string, any>} */
        this.modules = new Map();
        this.uniforms = device.createBuffer({ size: UNIFORMS, usage: 0x40 | 0x8 }); // UNIFORM, COPY_DST
        this.numbers = new ArrayBuffer(UNIFORMS);
        this.used = 0;
        /** @type {any} */
        this.encoder = null;
        /** @type {Buffer[]} destroyed when the commands that may use them are submitted */
        this.old = [];
    }

    /** A buffer with zeros. @param {number} bytes */
    make(bytes) {
        const size = Math.max(ALIGNMENT, Math.ceil(bytes / 4) * 4);
        return this.device.createBuffer({ size, usage: 0x80 | 0x8 | 0x4 }); // STORAGE, COPY_DST, COPY_SRC
    }

    /** A buffer with this content. @param {ArrayBufferView} content */
    upload(content) {
        const buffer = this.make(content.byteLength);
        this.device.queue.writeBuffer(buffer, 0, content);
        return buffer;
    }

    /** Memory that lasts until the next call with this name. @param {string} name @param {number} bytes @returns {Buffer} */
    temporary(name, bytes) {
        const known = this.scratch.get(name);
        if (known && known.size >= bytes) return known;
        if (known) this.old.push(known);
        const made = this.make(known ? Math.min(GROWTH * bytes, this.largest) : bytes);
        this.scratch.set(name, made);
        return made;
    }

    /** @param {Buffer[]} buffers */
    discard(...buffers) {
        this.old.push(...buffers);
    }

    /**
     * Queue the kernels of an operation.
     * @param {string} name
     * @param {Values} values
     */
    follow(name, values) {
        const { scratch = {}, steps } = this.plan[name];
        const all = { ...values };
        for (const [each, needs] of Object.entries(scratch))
            all[each] = this.temporary(`${name}.${each}`, (needs.items ? count(needs, all) : 1) * needs.bytes);
        for (const step of steps) {
            if (step.needs && !all[step.needs]) continue;
            if (step.over && all.binning_tiles_x * all.binning_tiles_y <= step.over) continue;
            const given = { ...all };
            for (const [number, value] of Object.entries(step.set ?? {}))
                given[number] = typeof value === "string" ? all[value] : value;
            for (const [variable, field] of Object.entries(step.bind ?? {})) given[variable] = all[field];
            this.run(step.file, step.entry, step.groups ?? count(step, all), given);
        }
    }

    /** Queue a kernel. @param {string} file @param {string} entry @param {number} groups @param {Values} values */
    run(file, entry, groups, values) {
        if (groups <= 0) return;
        const { bindings, uniform, numbers, pipeline } = this.kernel(file, entry);
        if (this.used + ALIGNMENT > UNIFORMS) this.submit();
        /** @type {{binding: number, resource: any}[]} */
        const entries = bindings.map(([name, binding]) => ({
            binding,
            resource: { buffer: values[name] ?? this.temporary(`nothing.${entry}.${name}`, 4) },
        }));
        const into = new DataView(this.numbers, this.used);
        numbers.forEach(([name, kind], i) => {
            const given = values[name.slice(4)];
            const number = Number(values[name] ?? (name.startsWith("has_") && given ? 1 : 0));
            if (kind === "f32") into.setFloat32(4 * i, number, true);
            else into.setUint32(4 * i, number, true);
        });
        const size = Math.ceil(numbers.length / 4) * 16;
        if (uniform >= 0)
            entries.push({ binding: uniform, resource: { buffer: this.uniforms, offset: this.used, size } });
        this.used += Math.ceil(size / ALIGNMENT) * ALIGNMENT;
        this.encoder ??= this.device.createCommandEncoder();
        const pass = this.encoder.beginComputePass();
        pass.setPipeline(pipeline);
        pass.setBindGroup(0, this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries }));
        const across = Math.min(groups, MOST_GROUPS);
        pass.dispatchWorkgroups(across, Math.ceil(groups / across));
        pass.end();
    }

    /** Queue a copy. @param {Buffer} from @param {Buffer} to @param {number} bytes @param {number} [at] in `to` */
    copy(from, to, bytes, at = 0) {
        this.encoder ??= this.device.createCommandEncoder();
        this.encoder.copyBufferToBuffer(from, 0, to, at, bytes);
    }

    submit() {
        if (this.encoder) {
            this.device.queue.writeBuffer(this.uniforms, 0, this.numbers, 0, this.used);
            this.device.queue.submit([this.encoder.finish()]);
        }
        this.encoder = null;
        this.used = 0;
        for (const buffer of this.old.splice(0)) buffer.destroy();
    }

    /** The first bytes of buffers, after all queued commands. @param {[Buffer, number][]} wanted */
    async read(wanted) {
        const copies = wanted.map(([buffer, bytes]) => {
            const copy = this.device.createBuffer({ size: Math.max(4, bytes), usage: 0x1 | 0x8 }); // MAP_READ, COPY_DST
            this.copy(buffer, copy, bytes);
            return copy;
        });
        this.submit();
        await Promise.all(copies.map(copy => copy.mapAsync(1)));
        return copies.map(copy => {
            const content = copy.getMappedRange().slice(0);
            copy.destroy();
            return content;
        });
    }

    /** @param {string} file */
    module(file) {
        let module = this.modules.get(file);
        if (!module) this.modules.set(file, (module = this.device.createShaderModule({ code: this.shaders[file] })));
        return module;
    }

    /**
     * Compile the kernels of operations, which takes long with some drivers.
     * @param {string[]} operations @param {(number: number, of: number) => void} report
     */
    async prepare(operations, report) {
        const steps = new Map(operations.flatMap(name => this.plan[name].steps).map(step => [step.entry, step.file]));
        let number = 0;
        for (const [entry, file] of steps) {
            report(++number, steps.size);
            const compute = { module: this.module(file), entryPoint: entry };
            this.describe(file, entry, await this.device.createComputePipelineAsync({ layout: "auto", compute }));
        }
    }

    /** @param {string} file @param {string} entry */
    kernel(file, entry) {
        const known = this.kernels.get(entry);
        if (known) return known;
        const compute = { module: this.module(file), entryPoint: entry };
        return this.describe(file, entry, this.device.createComputePipeline({ layout: "auto", compute }));
    }

    /** What a kernel binds. @param {string} file @param {string} entry @param {any} pipeline @returns {Kernel} */
    describe(file, entry, pipeline) {
        const code = this.shaders[file].replace(/\/\/[^\n]*/g, "");
        const starts = [...code.matchAll(FUNCTION)];
        const words = new Map(
            starts.map((start, i) => [start[2], new Set(code.slice(start.index, starts[i + 1]?.index).match(/\w+/g))]),
        );
        const used = wordsOf(entry, words);
        /** @type {[string, number][]} */
        const bindings = [];
        let uniform = -1;
        for (const [, index, kind, name] of code.matchAll(VARIABLE)) {
            if (!used.has(name)) continue;
            if (kind === "uniform") uniform = Number(index);
            else bindings.push([name, Number(index)]);
        }
        const fields = /struct Params\s*\{(.*?)\}/s.exec(code)?.[1] ?? "";
        const numbers = [...fields.matchAll(/(\w+)\s*:\s*(\w+)/g)].map(
            field => /** @type {[string, string]} */ ([field[1], field[2]]),
        );
        const kernel = { bindings, uniform, numbers, pipeline };
        this.kernels.set(entry, kernel);
        return kernel;
    }
}

/** @param {{of?: string[], plus?: number, items?: number}} needs @param {Values} values */
const count = ({ of = ["n"], plus = 0, items = 1 }, values) =>
    Math.ceil((of.reduce((product, field) => product * values[field], 1) + plus) / items);
