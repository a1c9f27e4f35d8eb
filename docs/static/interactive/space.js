// One object in the hand: Gaussians in space, drawn with WebGL 2. Four figures of the course show the
// same object, and keep its orientation from page to page.
(() => {
  "use strict";
  const { add, basis, slider, tick, signed, t, load, figure } = interactive;
  const SIZE = 330, DISTANCE = 4, FOCAL = 1.45 * SIZE, C0 = 0.28209479;

  // The data: see docs/learn/figures/interactive_space.py.
  function decoded() {
    const bytes = Uint8Array.from(atob(interactive.space.data), c => c.charCodeAt(0));
    let at = 0;
    const take = (count, low, high, size = 1) => Float32Array.from({ length: count }, () => {
      const value = size === 1 ? bytes[at] : bytes[at] + 256 * bytes[at + 1];
      at += size;
      return low + (high - low) * value / (size === 1 ? 255 : 65535);
    });
    const stages = interactive.space.stages.map(([step, count]) => {
      const stage = { step, count, mean: take(3 * count, -2, 2, 2), log: take(3 * count, -7, 1),
        quat: take(4 * count, -1, 1), opacity: take(count, 0, 1), dc: take(3 * count, -2.5, 2.5),
        born: take(count, 0, 255) };
      stage.sigma = Float32Array.from({ length: 6 * count }); // xx, xy, xz, yy, yz, zz
      for (let i = 0; i < count; i++) {
        const scales = [0, 1, 2].map(k => Math.exp(stage.log[3 * i + k]));
        stage.sigma.set(covariance(stage.quat.subarray(4 * i, 4 * i + 4), scales), 6 * i);
      }
      return stage;
    });
    const last = stages[stages.length - 1];
    last.rest = take(45 * last.count, -1, 1);
    return stages;
  }
  function covariance(quat, scales) { // Σ = R S Sᵀ Rᵀ
    const length = Math.hypot(...quat) || 1, [w, x, y, z] = Array.from(quat, v => v / length);
    const R = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
    const entry = (i, j) => scales.reduce((sum, s, k) => sum + R[i][k] * R[j][k] * s * s, 0);
    return [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)];
  }

  // The projection is that of the course: Σ' = J W Σ Wᵀ Jᵀ + 0.3 I.
  const VERTEX = `#version 300 es
    uniform mat3 W; uniform vec2 lens; uniform float size; // lens: focal length, distance
    in vec2 corner; in vec3 mean, s1, s2; in vec4 color;
    out vec2 d; flat out vec4 splat;
    void main() {
      vec3 p = W * mean; p.z += lens.y;
      mat3 S = W * mat3(s1.x, s1.y, s1.z, s1.y, s2.x, s2.y, s1.z, s2.y, s2.z) * transpose(W);
      vec3 jx = vec3(1.0, 0.0, -p.x / p.z) * lens.x / p.z, jy = vec3(0.0, 1.0, -p.y / p.z) * lens.x / p.z;
      float a = dot(jx, S * jx) + 0.3, b = dot(jx, S * jy), c = dot(jy, S * jy) + 0.3;
      float mid = 0.5 * (a + c), r = length(vec2(0.5 * (a - c), b)), large = mid + r;
      vec2 u = abs(b) > 1e-5 ? normalize(vec2(b, large - a)) : a >= c ? vec2(1, 0) : vec2(0, 1);
      d = corner * 3.2; splat = color;
      vec2 pixel = lens.x * p.xy / p.z + d.x * sqrt(large) * u
        + d.y * sqrt(max(mid - r, 0.1)) * vec2(-u.y, u.x);
      gl_Position = vec4(2.0 * pixel.x / size, -2.0 * pixel.y / size, 0.0, 1.0);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec2 d; flat in vec4 splat; out vec4 shown;
    void main() {
      float alpha = min(0.99, abs(splat.a) * exp(-0.5 * dot(d, d)));
      if (splat.a < 0.0) alpha = dot(d, d) < 4.0 ? abs(splat.a) : 0.0; // an ellipsoid of 2 σ
      if (alpha < 1.0 / 255.0) discard;
      shown = vec4(splat.rgb * alpha, alpha);
    }`;
  function painter(canvas) {
    const gl = canvas.getContext("webgl2", { alpha: true, depth: false, preserveDrawingBuffer: true });
    if (!gl) return null;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
    gl.useProgram(program);
    const place = name => gl.getAttribLocation(program, name);
    const uniform = name => gl.getUniformLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place("corner"));
    gl.vertexAttribPointer(place("corner"), 2, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    [["mean", 3], ["s1", 3], ["s2", 3], ["color", 4]].reduce((offset, [name, length]) => {
      gl.enableVertexAttribArray(place(name));
      gl.vertexAttribPointer(place(name), length, gl.FLOAT, false, 52, offset);
      gl.vertexAttribDivisor(place(name), 1);
      return offset + 4 * length;
    }, 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    return (rows, W) => { // rows: from back to front, 13 numbers each
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(1, 1, 1, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      const scale = canvas.width / SIZE;
      gl.uniformMatrix3fv(uniform("W"), true, W.flat());
      gl.uniform2f(uniform("lens"), FOCAL * scale, DISTANCE);
      gl.uniform1f(uniform("size"), canvas.width);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(rows.flat()), gl.DYNAMIC_DRAW);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, rows.length);
    };
  }

  // The orientation is the same in all figures, on all pages of this visit.
  const stored = (() => {
    try { return JSON.parse(sessionStorage.getItem("space")); } catch { return null; }
  })();
  const turn = Array.isArray(stored) ? stored : [-0.5, 0.25], views = [];
  function rotate(right, down) {
    turn[0] += right;
    turn[1] = Math.max(-1.5, Math.min(1.5, turn[1] + down));
    try { sessionStorage.setItem("space", JSON.stringify(turn)); } catch { /* not allowed: forgotten */ }
    for (const draw of views) draw();
  }
  function rotation() { // W: first around y, which is down, then around x
    const [c, s, C, S] = [Math.cos(turn[0]), Math.sin(turn[0]), Math.cos(turn[1]), Math.sin(turn[1])];
    return [[c, 0, s], [S * s, C, -S * c], [-C * s, S, C * c]];
  }

  // A figure: choose(W) returns Gaussians { mean, sigma, color, alpha }, from back to front if `sorted`.
  function space(name, build) {
    figure(`space-${name}`, async parts => {
      await load("space-data.js");
      const { element, panels, status } = parts, stages = decoded();
      const canvas = add(panels, "canvas", { class: "space", tabindex: 0, role: "img",
        width: 2 * SIZE, height: 2 * SIZE,
        "aria-label": t("A snowman of Gaussians; turn it with the arrow keys", "由高斯组成的雪人；用方向键转动") });
      const paint = painter(canvas);
      if (!paint) {
        status.textContent = t("This browser has no WebGL 2.", "此浏览器没有 WebGL 2。");
        return;
      }
      const choose = build(parts, stages, () => draw());
      function draw() {
        const W = rotation(), { rows, words, sorted = true } = choose(W);
        const depth = row => W[2][0] * row[0] + W[2][1] * row[1] + W[2][2] * row[2];
        const shown = sorted ? rows.sort((a, b) => depth(b) - depth(a)) : rows;
        paint(choose.cut ? choose.cut(shown) : shown, W);
        element.dataset.turn = turn.map(v => v.toFixed(3));
        status.textContent = words;
      }
      canvas.addEventListener("keydown", event => {
        const way = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
        if (!way) return;
        event.preventDefault();
        rotate(way[0] * 0.15, way[1] * 0.15);
      });
      let [x, y] = [0, 0]; // see harmonics.js
      canvas.addEventListener("pointerdown", event => {
        canvas.setPointerCapture(event.pointerId);
        [x, y] = [event.clientX, event.clientY];
      });
      canvas.addEventListener("pointermove", event => {
        if (!canvas.hasPointerCapture(event.pointerId)) return;
        rotate((x - event.clientX) / 100, (event.clientY - y) / 100);
        [x, y] = [event.clientX, event.clientY];
      });
      views.push(draw);
      draw();
    });
  }
  const eye = W => [0, 1, 2].map(k => -DISTANCE * W[2][k]); // −Wᵀ t
  const row = (stage, i, color, alpha = stage.opacity[i]) =>
    [...stage.mean.subarray(3 * i, 3 * i + 3), ...stage.sigma.subarray(6 * i, 6 * i + 6), ...color, alpha];
  const plain = (stage, i) => [0, 1, 2].map(k => Math.max(0, 0.5 + C0 * stage.dc[3 * i + k]));
  function colored(stage, i, camera, degree) {
    const color = [0, 1, 2].map(k => 0.5 + C0 * stage.dc[3 * i + k]);
    if (degree > 0) {
      const v = [0, 1, 2].map(k => stage.mean[3 * i + k] - camera[k]), n = Math.hypot(...v);
      const y = basis(v[0] / n, v[1] / n, v[2] / n).slice(1, (degree + 1) ** 2);
      for (let k = 0; k < 3; k++)
        y.forEach((value, j) => { color[k] += value * stage.rest[45 * i + 15 * k + j]; });
    }
    return color.map(c => Math.max(0, c));
  }
  const all = (stage, color) => Array.from({ length: stage.count }, (_, i) => row(stage, i, color(i)));

  space("ellipsoid", ({ controls, panels, element }, stages, draw) => {
    const last = stages[stages.length - 1], values = { s1: 0.6, s2: 0.25, s3: 0.12, x: 0.2, y: 0.3, z: 0.4 };
    const numbers = add(panels, "pre", { class: "numbers" });
    for (const name in values)
      slider(controls, name, name.replace(/\d/, d => "₀₁₂₃"[d]),
        name[0] === "s" ? [0.02, 0.8, 0.01, values[name]] : [-1, 1, 0.01, values[name]],
        value => { values[name] = value; draw(); });
    return () => {
      const { s1, s2, s3, x, y, z } = values, m = covariance([1, x, y, z], [s1, s2, s3]);
      const [a, b, c, d, e, f] = m.map(v => signed(v, 3).padStart(7));
      numbers.textContent = `q = (1, ${[x, y, z].map(v => signed(v)).join(", ")})\n\nΣ = ${a} ${b} ${c}\n    ${b} ${d} ${e}\n    ${c} ${e} ${f}`;
      element.dataset.sigma = m.map(v => v.toFixed(6));
      const rows = all(last, i => plain(last, i)).map(each => [...each.slice(0, 12), 0.25 * each[12]]);
      rows.push([0, 0, 0, ...m, 0.85, 0.4, 0.1, -0.75]);
      return { rows, words: t("The orange ellipsoid: all points within 2 σ.", "橙色椭球：2 σ 以内的所有点。") };
    };
  });
  space("degrees", ({ controls, element }, stages, draw) => {
    const last = stages[stages.length - 1];
    let degree = 3;
    slider(controls, "degree", t("degrees up to", "最高阶数"), [0, 3, 1, degree], value => { degree = value; draw(); });
    return W => {
      element.dataset.degree = degree;
      const camera = eye(W), count = (degree + 1) ** 2;
      return { rows: all(last, i => colored(last, i, camera, degree)),
        words: t(`${count} coefficients for each colour channel.`, `每个颜色通道 ${count} 个系数。`) };
    };
  });
  space("order", ({ controls, element }, stages, draw) => {
    const last = stages[stages.length - 1];
    let removed = 0, sorted = true;
    slider(controls, "removed", t("removed from the front", "从最前面移除"), [0, last.count, 1, 0],
      value => { removed = value; draw(); });
    tick(controls, "sorted", t("sort by depth", "按深度排序"), value => { sorted = value; draw(); }, true);
    const choose = W => {
      element.dataset.removed = removed;
      const camera = eye(W);
      return { sorted, rows: all(last, i => colored(last, i, camera, 3)), words:
        t(`${last.count - removed} of ${last.count} Gaussians, ${sorted ? "from back to front" : "in the order of the file"}.`,
          `${last.count} 个高斯中的 ${last.count - removed} 个，${sorted ? "从后到前" : "按文件中的顺序"}。`) };
    };
    choose.cut = rows => rows.slice(0, rows.length - removed);
    return choose;
  });
  space("training", ({ controls, element }, stages, draw) => {
    let now = 0, marked = true;
    slider(controls, "stage", t("moment", "时刻"), [0, stages.length - 1, 1, now], value => { now = value; draw(); });
    tick(controls, "marked", t("colour what is new", "给新的高斯着色"), value => { marked = value; draw(); }, true);
    return W => {
      const stage = stages[now], camera = eye(W), births = [1, 2].map(kind => stage.born.filter(b => b === kind).length);
      element.dataset.count = stage.count;
      const color = i => (marked && stage.born[i] ? [[0.1, 0.6, 0.35], [0.9, 0.45, 0.1]][stage.born[i] - 1]
        : stage.rest ? colored(stage, i, camera, 3) : plain(stage, i));
      const [cloned, split] = births;
      const what = cloned + split
        ? t(`densified: ${cloned} Gaussians are clones and their originals (green), ${split} are halves of split ones (orange)`,
          `稠密化：${cloned} 个高斯是克隆体及其原体（绿色），${split} 个由分裂产生（橙色）`)
        : now ? t("after these steps", "经过这些步之后") : t("one ball for each point", "每个点一个球");
      return { rows: all(stage, color), words: t(`Step ${stage.step}, ${stage.count} Gaussians: ${what}.`,
        `第 ${stage.step} 步，${stage.count} 个高斯：${what}。`) };
    };
  });
})();
