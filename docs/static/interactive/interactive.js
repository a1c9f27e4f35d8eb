// The interactive figures of the course. `<div class="interactive" data-figure="name">` becomes the
// figure that name.js draws. Classic scripts, because browsers do not load modules from files.
// Without scripts, the element shows its text, and the page shows its drawings.
(() => {
  "use strict";
  const folder = document.currentScript.src.replace(/[^/]*$/, "");
  const chinese = document.documentElement.lang.startsWith("zh");
  const t = (english, chineseText) => (chinese ? chineseText : english);
  const signed = (v, digits = 2) => {
    const text = v.toFixed(digits);
    return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
  };

  function add(parent, tag, attributes = {}, text = "") {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.textContent = text;
    return parent.appendChild(element);
  }

  const shows = []; // write the values of the sliders beside them
  // Controls. Each returns its input element; `change` is called with the new value.
  function slider(parent, name, label, [min, max, step, value], change) {
    const box = add(parent, "label", {}, `${label} `);
    const input = add(box, "input", { type: "range", name, min, max, step, value });
    const shown = add(box, "output"), digits = (String(step).split(".")[1] ?? "").length;
    const show = () => { shown.textContent = signed(Number(input.value), digits); };
    input.addEventListener("input", () => { show(); change(Number(input.value)); });
    shows.push(show);
    show();
    return input;
  }
  function choice(parent, name, label, options, change) { // options: [value, text]
    const box = add(parent, "label", {}, `${label} `), input = add(box, "select", { name });
    for (const [value, text] of options) add(input, "option", { value }, text);
    input.addEventListener("change", () => change(input.value));
    return input;
  }
  function tick(parent, name, label, change, checked = false) {
    const box = add(parent, "label"), input = add(box, "input", { type: "checkbox", name });
    box.append(` ${label}`);
    input.checked = checked;
    input.addEventListener("change", () => change(input.checked));
    return input;
  }
  function button(parent, name, label, press) {
    const input = add(parent, "button", { type: "button", name }, label);
    input.addEventListener("click", press);
    return input;
  }

  // A plot of `width` × `height` units with data coordinates x, y (y goes up if y[0] < y[1]).
  // draw(content, handles): the SVG content, and handles that are dragged or moved by arrow keys:
  // { name, label, at: [x, y], colour, move(x, y, way), text }; `way` is that of an arrow key.
  // press(x, y), if given, is called for a click beside the handles.
  function plot(parent, label, width, height, x, y, press = null) {
    const margin = 8;
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    for (const [name, value] of Object.entries({ viewBox: `0 0 ${width} ${height}`, width, height,
      role: "group", "aria-label": label })) svg.setAttribute(name, value);
    parent.append(svg);
    const X = u => margin + (u - x[0]) / (x[1] - x[0]) * (width - 2 * margin);
    const Y = v => height - margin - (v - y[0]) / (y[1] - y[0]) * (height - 2 * margin);
    let shown = [], dragged = null;
    const at = event => {
      const box = svg.getBoundingClientRect(), u = (event.clientX - box.left) / box.width * width;
      const v = (event.clientY - box.top) / box.height * height;
      return [x[0] + (u - margin) / (width - 2 * margin) * (x[1] - x[0]),
        y[0] + (height - margin - v) / (height - 2 * margin) * (y[1] - y[0])];
    };
    const find = name => shown.find(handle => handle.name === name);
    const named = event => event.target.closest?.("[data-handle]")?.dataset.handle;
    svg.addEventListener("pointerdown", event => {
      dragged = named(event) || null;
      if (!dragged) return press?.(...at(event));
      event.preventDefault();
      svg.setPointerCapture(event.pointerId);
      svg.querySelector(`[data-handle=${dragged}]`).focus();
    });
    svg.addEventListener("pointermove", event => { if (dragged) find(dragged)?.move(...at(event)); });
    for (const end of ["pointerup", "pointercancel"])
      svg.addEventListener(end, () => { dragged = null; });
    svg.addEventListener("keydown", event => {
      const handle = find(named(event)), way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0],
        ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (!handle || !way) return;
      event.preventDefault();
      const step = (event.shiftKey ? 4 : 1) * Math.abs(x[1] - x[0]) / 60;
      handle.move(handle.at[0] + way[0] * step,
        handle.at[1] + way[1] * step * Math.sign(y[1] - y[0]), way);
    });
    const draw = (content, handles = []) => {
      const focused = svg.contains(document.activeElement) && document.activeElement.dataset.handle;
      shown = handles;
      for (const show of shows) show(); // a handle may have changed the value of a slider
      svg.innerHTML = content + handles.map(h => `<g class="handle" tabindex="0" role="slider"
        data-handle="${h.name}" aria-label="${h.label}" aria-valuenow="${h.at[0].toFixed(2)}"
        aria-valuetext="${h.text ?? h.at.map(v => signed(v)).join(", ")}">
        <circle cx="${X(h.at[0])}" cy="${Y(h.at[1])}" r="18" fill="transparent"/>
        <circle cx="${X(h.at[0])}" cy="${Y(h.at[1])}" r="7" class="f-${h.colour ?? "orange"}"/></g>`)
        .join("");
      if (focused) svg.querySelector(`[data-handle=${focused}]`)?.focus();
    };
    return { svg, X, Y, draw };
  }
  const text = (x, y, words, more = "") =>
    `<text x="${x}" y="${y}" font-size="12" class="f-soft" ${more}>${words}</text>`;
  const path = (points, colour, more = "") =>
    `<path d="M${points.map(p => p.map(v => v.toFixed(1)).join(" ")).join("L")}" fill="none"
      stroke-width="2" class="s-${colour}" ${more}/>`;
  // 65 points of { mean + k M u }, |u| = 1, for the 2×2 matrix M = [[a, b], [c, d]].
  const ellipse = ([x, y], [[a, b], [c, d]], k = 1) => Array.from({ length: 65 }, (_, i) => {
    const u = k * Math.cos(i * Math.PI / 32), v = k * Math.sin(i * Math.PI / 32);
    return [x + a * u + b * v, y + c * u + d * v];
  });
  // Eigenvalues of [[a, b], [b, c]], the larger first, and the angle of the first eigenvector.
  const eigen = (a, b, c) => {
    const mean = (a + c) / 2, half = Math.hypot((a - c) / 2, b);
    return [mean + half, mean - half, Math.atan2(2 * b, a - c) / 2];
  };

  // What to try with each figure.
  const TRY = {
    covariance: t("Try: make Σ₁₂ so large that no ellipse has this matrix.", "试一试：把 Σ₁₂ 调大，直到没有椭圆具有这个矩阵。"),
    projection: t("Try: move a large Gaussian to the camera. Where does the approximation fail?",
      "试一试：把一个大的高斯移向相机。近似在哪里失效？"),
    harmonics: t("Try: which degree does a narrow highlight need? An edge?", "试一试：窄的高光需要几阶？边界呢？"),
    blending: t("Try: reverse the order, and find a colour that stays the same.", "试一试：颠倒顺序，找一种不变的颜色。"),
    tiles: t("Try: how many instances does the rule of a square add?", "试一试：正方形规则多出多少个实例？"),
    density: t("Try: lower the threshold, and count what is split.", "试一试：降低阈值，数一数有多少被分裂。"),
    fit: t("Try: a photo of yours with 100 and with 1000 Gaussians.", "试一试：用 100 个和 1000 个高斯拟合您的照片。"),
    "space-ellipsoid": t("Try: two equal scales. Which rotations change Σ now?", "试一试：两个尺度相等。现在哪些旋转会改变 Σ？"),
    "space-degrees": t("Try: turn the snowman with degree 0, then 3. What moves?", "试一试：先用 0 阶，再用 3 阶转动雪人。什么在动？"),
    "space-order": t("Try: switch sorting off, and turn. From where does it look right?", "试一试：关闭排序再转动。从哪里看是对的？"),
    "space-training": t("Try: find a Gaussian that is cloned, and one that is split. Which is larger?",
      "试一试：找一个被克隆的高斯和一个被分裂的高斯。哪个更大？"),
  };
  const figures = {};
  function basis(x, y, z) { // the 16 spherical harmonics of the course, in its order and with its signs
    const xx = x * x, yy = y * y, zz = z * z;
    return [0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
      1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2 * zz - xx - yy),
      -1.09254843 * x * z, 0.54627422 * (xx - yy),
      -0.59004359 * y * (3 * xx - yy), 2.89061144 * x * y * z,
      -0.45704580 * y * (4 * zz - xx - yy), 0.37317633 * z * (2 * zz - 3 * xx - 3 * yy),
      -0.45704580 * x * (4 * zz - xx - yy), 1.44530572 * z * (xx - yy),
      -0.59004359 * x * (xx - 3 * yy)];
  }

  window.interactive = { add, basis, slider, choice, tick, button, plot, text, path,
    ellipse, eigen, signed, t, load, figure: (name, draw) => { figures[name] = draw; } };
  const loaded = {};
  function load(file) { // a script of this folder, once
    return loaded[file] ??= new Promise((done, failed) => {
      const script = add(document.head, "script", { src: folder + file });
      script.onload = done;
      script.onerror = () => failed(new Error(`${file} cannot be loaded`));
    });
  }
  for (const element of document.querySelectorAll("[data-figure]"))
    load(`${element.dataset.figure.split("-")[0]}.js`).then(() => {
      element.textContent = "";
      const controls = add(element, "div", { class: "controls" });
      const panels = add(element, "div", { class: "panels" });
      const status = add(element, "p", { class: "status", role: "status" });
      add(element, "p", { class: "try" }, TRY[element.dataset.figure]);
      return figures[element.dataset.figure]({ element, controls, panels, status });
    });
})();
