// Decodes the data of the page, and draws the globe with WebGL 2.
"use strict";

const element = id => document.getElementById(id);
const about = JSON.parse(element("about").textContent);
const C = about.constants;

// ---- Data

function decode() {
    const text = atob(element("data").textContent);
    element("data").remove();
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const kinds = { i2: Int16Array, u1: Uint8Array, i1: Int8Array };
    const columns = {};
    for (const { name, kind, offset, length, scale, low } of about.columns) {
        const values = new kinds[kind](bytes.buffer, offset, length);
        columns[name] = Float32Array.from(values, value => low + scale * value);
    }
    return columns;
}

// Six texels of parameters for each Gaussian: see splats.vert.
function parametersOf(columns, count, width) {
    const data = new Float32Array(4 * width * Math.ceil((6 * count) / width));
    const heights = randomNumbers(count, 9),
        azimuths = randomNumbers(count, 10);
    for (let i = 0; i < count; i++) {
        const at = 24 * i;
        data.set(columns.log_scales.subarray(3 * i, 3 * i + 3), at);
        data[at + 3] = columns.opacity[i];
        data.set(columns.quat.subarray(4 * i, 4 * i + 4), at + 4);
        data.set(columns.color.subarray(3 * i, 3 * i + 3), at + 8);
        data[at + 11] = 2 * Math.PI * azimuths[i];
        for (let axis = 0; axis < 3; axis++) {
            const from = 9 * i + 3 * axis;
            data.set(columns.sh.subarray(from, from + 3), at + 12 + 4 * axis);
        }
        data[at + 15] = 2 * heights[i] - 1;
    }
    return data;
}

// ---- WebGL

function program(gl, vertex, fragment) {
    const linked = gl.createProgram();
    for (const [kind, source] of [
        [gl.VERTEX_SHADER, vertex],
        [gl.FRAGMENT_SHADER, fragment],
    ]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${source}`);
        gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
            throw new Error(gl.getShaderInfoLog(shader));
        }
        gl.attachShader(linked, shader);
    }
    gl.bindAttribLocation(linked, 0, "corner");
    gl.bindAttribLocation(linked, 1, "index");
    gl.linkProgram(linked);
    if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(linked));
    const uniforms = {};
    const number = gl.getProgramParameter(linked, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < number; i++) {
        const { name } = gl.getActiveUniform(linked, i);
        uniforms[name] = gl.getUniformLocation(linked, name);
    }
    return { linked, uniforms };
}

function texture(gl, unit, format, width, height, layout, type, data) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    const filter = type === gl.FLOAT ? gl.NEAREST : gl.LINEAR;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    if (data instanceof HTMLCanvasElement) {
        gl.texImage2D(gl.TEXTURE_2D, 0, format, layout, type, data);
    } else {
        gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, layout, type, data);
    }
    return made;
}

// The name of the scene, for the plate on the base.
function engraving(name) {
    const canvas = document.createElement("canvas");
    canvas.width = 1024;
    canvas.height = Math.round((1024 * C.PLATE[1]) / (C.PLATE[0] * C.BASE[1][2]));
    const context = canvas.getContext("2d");
    context.fillStyle = "#000";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = "#fff";
    context.textAlign = "center";
    context.textBaseline = "middle";
    let points = 0.5 * canvas.height;
    do {
        context.font = `500 ${points}px Georgia, "Times New Roman", serif`;
        points *= 0.94;
    } while (context.measureText(name).width > 0.86 * canvas.width && points > 8);
    context.fillText(name, canvas.width / 2, canvas.height * 0.53);
    return canvas;
}

const STATE_WIDTH = 1024,
    PARAMETER_WIDTH = 1536; // texels; a multiple of 6

class Renderer {
    constructor(canvas, columns, count) {
        const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false });
        if (!gl) throw new Error("no WebGL 2");
        this.gl = gl;
        this.canvas = canvas;
        const { shaders, glsl } = about;
        const screen = "in vec2 corner; void main() { gl_Position = vec4(corner, 0.0, 1.0); }";
        this.behind = program(gl, screen, glsl + shaders.common + shaders.behind);
        this.front = program(gl, screen, glsl + shaders.common + shaders.front);
        this.splats = program(gl, glsl + shaders.vertex, shaders.fragment);
        this.rows = Math.ceil(count / STATE_WIDTH);
        this.state = texture(gl, 0, gl.RGBA32F, STATE_WIDTH, this.rows, gl.RGBA, gl.FLOAT, null);
        const parameters = parametersOf(columns, count, PARAMETER_WIDTH);
        texture(
            gl,
            1,
            gl.RGBA32F,
            PARAMETER_WIDTH,
            parameters.length / 4 / PARAMETER_WIDTH,
            gl.RGBA,
            gl.FLOAT,
            parameters,
        );
        texture(gl, 2, gl.R8, 0, 0, gl.RED, gl.UNSIGNED_BYTE, engraving(about.name));
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        const corners = new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]);
        gl.bufferData(gl.ARRAY_BUFFER, corners, gl.STATIC_DRAW);
        gl.enableVertexAttribArray(0);
        gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
        this.order = gl.createBuffer();
        gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
        gl.bufferData(gl.ARRAY_BUFFER, 4 * count, gl.DYNAMIC_DRAW);
        gl.enableVertexAttribArray(1);
        gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
        gl.vertexAttribDivisor(1, 1);
        this.target = gl.createFramebuffer();
        this.count = 0;
    }

    // The Gaussians to display: a result of the worker.
    update({ state, order, count }) {
        const { gl } = this;
        gl.activeTexture(gl.TEXTURE0);
        gl.bindTexture(gl.TEXTURE_2D, this.state);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, STATE_WIDTH, this.rows, gl.RGBA, gl.FLOAT, state);
        gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
        gl.bufferSubData(gl.ARRAY_BUFFER, 0, order, 0, count);
        this.count = count;
    }

    resize(width, height) {
        const { gl, canvas } = this;
        if (canvas.width === width && canvas.height === height && this.inside) return;
        canvas.width = width;
        canvas.height = height;
        if (this.inside) gl.deleteTexture(this.inside);
        this.inside = texture(gl, 3, gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.inside, 0);
    }

    // globe, scene: cameras {position, axes} in front of the globe, and of the turned scene.
    draw(globe, scene, focal, centre) {
        const { gl, canvas } = this;
        const lens = ({ uniforms }) => {
            gl.uniform2f(uniforms.focal, focal, focal);
            gl.uniform2fv(uniforms.centre, centre);
            gl.uniform2f(uniforms.size, canvas.width, canvas.height);
        };
        const backdrop = pass => {
            gl.useProgram(pass.linked);
            lens(pass);
            gl.uniformMatrix3fv(pass.uniforms.turn, false, globe.axes.flat());
            gl.uniform3fv(pass.uniforms.origin, globe.position);
            gl.uniform1i(pass.uniforms.plate, 2);
            gl.uniform1i(pass.uniforms.inside, 3);
            gl.disable(gl.BLEND);
            gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
        };
        gl.viewport(0, 0, canvas.width, canvas.height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
        backdrop(this.behind);
        gl.useProgram(this.splats.linked);
        lens(this.splats);
        gl.uniformMatrix3fv(this.splats.uniforms.camera, true, scene.axes.flat());
        gl.uniform3fv(this.splats.uniforms.eye, scene.position);
        gl.uniform1i(this.splats.uniforms.state, 0);
        gl.uniform1i(this.splats.uniforms.parameters, 1);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
        gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        backdrop(this.front);
    }
}
