// The interactive figure of "Why the start matters": Gaussians on a line are fitted to a target.
// Loss and gradient are the closed forms of the page. Without this script, the page has a picture.
(() => {
  "use strict";
  const root = document.getElementById("basin");
  if (!root) return;
  const chinese = document.documentElement.lang.startsWith("zh");
  const say = (english, chineseText) => (chinese ? chineseText : english);
  const STEPS = 800, RANGE = 10, FOUND = 0.01, BLUR = 4, NOISE = 0.05;
  const RATES = { descent: 0.3, adam: 0.05 };
  const TARGETS = { one: [[0, 1, 1]], two: [[-2, 0.7, 1], [3, 1, 0.7]] }; // mean, σ, amplitude

  root.innerHTML = `
    <div class="controls">
      <label>${say("Target", "目标")} <select name="target">
        <option value="one">${say("one Gaussian", "一个高斯")}</option>
        <option value="two">${say("two Gaussians", "两个高斯")}</option></select></label>
      <label>${say("Gaussians", "高斯数")} <select name="count"><option>1</option><option>2</option>
        <option>3</option></select></label>
      <label>${say("Optimiser", "优化器")} <select name="optimiser">
        <option value="descent">${say("gradient descent", "梯度下降")}</option>
        <option value="adam">Adam</option></select></label>
      <label><input type="checkbox" name="blur"> ${say("blur first", "先模糊")}</label>
      <label><input type="checkbox" name="noise"> ${say("noise", "噪声")}</label>
      <span><button type="button" name="run"></button>
      <button type="button" name="back">${say("Back to start", "回到起点")}</button></span>
    </div>
    <svg class="signal" role="group" aria-label="${say("Target, model and the basin", "目标、模型和吸引域")}"></svg>
    <p class="status" role="status"></p>
    <div class="panels"><svg class="loss" width="330" height="170" viewBox="0 0 330 170" role="img"
      aria-label="${say("Relative error by step", "各步的相对误差")}"></svg><svg class="pull" width="330" height="170"
      viewBox="0 0 330 170" role="img" aria-label="${say("Gradient by position", "各位置的梯度")}"></svg></div>`;
  const part = name => root.querySelector(name);
  const field = name => part(`[name=${name}]`);
  const [signal, lossPanel, pullPanel] = [".signal", ".loss", ".pull"].map(part);

  // Maths. A Gaussian is { m, l, a }: mean, log σ, amplitude.
  const decay = share => 0.5 + 0.5 * Math.cos(Math.PI * share);
  const overlap = (d, v, w) =>
    Math.sqrt(2 * Math.PI * v * w / (v + w)) * Math.exp(-d * d / (2 * (v + w)));
  const variance = g => Math.exp(2 * g.l);
  const targets = blur => TARGETS[field("target").value].map(([m, s, a]) => {
    const v = s * s + blur * blur; // wider and lower, with the same integral
    return { m, l: Math.log(v) / 2, a: a * s / Math.sqrt(v) };
  });
  const value = (list, x) =>
    list.reduce((sum, g) => sum + g.a * Math.exp(-((x - g.m) ** 2) / (2 * variance(g))), 0);
  const energy = (p, q) => {
    let sum = 0;
    for (const g of p) for (const h of q)
      sum += g.a * h.a * overlap(g.m - h.m, variance(g), variance(h));
    return sum;
  };
  const relativeError = p => {
    const t = targets(0), own = energy(t, t);
    return (energy(p, p) - 2 * energy(p, t) + own) / own;
  };
  function gradient(g, p, t) {
    const v = variance(g), result = { m: 0, l: 0, a: 0 };
    const add = (h, weight) => {
      const w = variance(h), d = g.m - h.m, o = weight * overlap(d, v, w), sum = v + w;
      result.m -= g.a * o * d / sum;
      result.l += g.a * o * (w / sum + d * d * v / (sum * sum));
      result.a += o;
    };
    for (const h of p) add(h, h.a);
    for (const h of t) add(h, -h.a);
    return result;
  }

  // A fit: an object with the Gaussians and the state of the optimiser.
  const copy = list => list.map(g => ({ ...g }));
  const begin = list => ({ p: copy(list), first: [], second: [], step: 0, seed: 1 });
  function random(fit) { // uniform in 0..1, the same sequence in each fit (mulberry32)
    let t = fit.seed += 0x6D2B79F5;
    t = Math.imul(t ^ t >>> 15, t | 1);
    t ^= t + Math.imul(t ^ t >>> 7, t | 61);
    return ((t ^ t >>> 14) >>> 0) / 4294967296 || 1e-9;
  }
  const blurAt = fit =>
    field("blur").checked && fit.step ? BLUR * Math.max(0, 1 - fit.step / STEPS / 0.6) : 0;
  function advance(fit, options) {
    fit.step++;
    const scale = decay(fit.step / STEPS), t = options.blur ? targets(blurAt(fit)) : options.target;
    const grads = fit.p.map(g => gradient(g, fit.p, t));
    fit.p.forEach((g, i) => {
      const m1 = fit.first[i] ||= { m: 0, l: 0, a: 0 }, m2 = fit.second[i] ||= { m: 0, l: 0, a: 0 };
      for (const k of ["m", "l", "a"]) {
        let change = grads[i][k];
        if (options.adam) {
          m1[k] = 0.9 * m1[k] + 0.1 * change;
          m2[k] = 0.999 * m2[k] + 0.001 * change * change;
          change = m1[k] / (1 - 0.9 ** fit.step) /
            (Math.sqrt(m2[k] / (1 - 0.999 ** fit.step)) + 1e-15);
        }
        g[k] -= options.rate * scale * change;
      }
      if (options.noise)
        g.m += NOISE * scale * Math.exp(g.l) * Math.sqrt(-2 * Math.log(random(fit))) *
          Math.cos(2 * Math.PI * random(fit));
      g.l = Math.min(Math.max(g.l, -3), 3);
    });
  }
  const settings = () => ({
    adam: field("optimiser").value === "adam", rate: RATES[field("optimiser").value],
    blur: field("blur").checked, noise: field("noise").checked, target: targets(0),
  });

  // Drawing
  const line = (x, y, from, to, n, f) => {
    let path = "";
    for (let i = 0; i <= n; i++) {
      const u = from + (to - from) * i / n;
      path += `${i ? "L" : "M"}${x(u).toFixed(1)} ${y(f(u)).toFixed(1)}`;
    }
    return path;
  };
  const text = (x, y, words, more = "") =>
    `<text x="${x}" y="${y}" font-size="12" class="f-soft" ${more}>${words}</text>`;
  const curve = (path, colour, more = "", thick = 2) =>
    `<path d="${path}" fill="none" stroke-width="${thick}" class="s-${colour}" ${more}/>`;
  const signed = v => String(v).replace("-", "−");
  function number(v) { // two digits, as 3.7·10⁻⁹
    if (v >= 0.001 || v === 0) return String(Number(v.toPrecision(2)));
    const [digits, power] = v.toExponential(1).split("e-");
    return `${digits}·10⁻${[...power].map(c => "⁰¹²³⁴⁵⁶⁷⁸⁹"[c]).join("")}`;
  }

  let start, fit, active = 0, errors = [], running = false, basin = [], width = 0;

  function drawSignal() {
    width = Math.max(300, Math.min(700, root.clientWidth));
    const height = 250, x = u => 8 + (u + RANGE) / (2 * RANGE) * (width - 16);
    const y = f => 178 - 128 * Math.max(-0.3, Math.min(1.35, f));
    signal.setAttribute("viewBox", `0 0 ${width} ${height}`);
    signal.setAttribute("height", height);
    signal.setAttribute("width", width);
    const t = targets(0), blur = blurAt(fit), cell = (width - 16) / basin.length;
    const top = line(x, y, -RANGE, RANGE, 200, u => value(t, u));
    let svg = `<path d="${top}L${x(RANGE)} ${y(0)}L${x(-RANGE)} ${y(0)}Z" class="f-soft"
      fill-opacity="0.25"/>` + curve(`M8 ${y(0)}H${width - 8}`, "line", "", 1);
    if (blur) svg += curve(line(x, y, -RANGE, RANGE, 200, u => value(targets(blur), u)), "soft",
      'stroke-dasharray="4 4"');
    basin.forEach((found, i) => {
      svg += `<rect x="${(8 + i * cell).toFixed(1)}" y="222" width="${(cell + 0.3).toFixed(1)}"
        height="${found ? 10 : 3}" class="f-${found ? "green" : "soft"}"/>`;
    });
    svg += text(8, 214, say("start positions; green: the target would be found",
      "起始位置；绿色：能找到目标"));
    for (let u = -RANGE; u <= RANGE; u += 5)
      svg += text(x(u), 247, signed(u),
        `text-anchor="${u === -RANGE ? "start" : u === RANGE ? "end" : "middle"}"`);
    if (fit.p.length > 1) for (const g of fit.p)
      svg += curve(line(x, y, -RANGE, RANGE, 200, u => value([g], u)), "blue",
        'stroke-opacity="0.4"');
    svg += curve(line(x, y, -RANGE, RANGE, 200, u => value(fit.p, u)), "blue");
    svg += text(8, 14, say("grey: target, blue: model; ● position, ◆ width",
      "灰色：目标，蓝色：模型；● 位置，◆ 宽度"));
    fit.p.forEach((g, i) => {
      const s = Math.exp(g.l), px = x(g.m), py = y(g.a), qx = x(g.m + s), qy = y(g.a * 0.607);
      const label = fit.p.length > 1 ? say(` of Gaussian ${i + 1}`, `（高斯 ${i + 1}）`) : "";
      const names = { width: say("width", "宽度"), position: say("position", "位置") };
      const handle = (name, now, cx, cy, shape) => `<g class="handle" tabindex="0" role="slider"
        data-handle="${name}${i}" aria-label="${names[name]}${label}" aria-valuenow="${now.toFixed(2)}"
        aria-valuemin="${name === "width" ? 0.1 : -RANGE}" aria-valuemax="${RANGE}">
        <circle cx="${cx}" cy="${cy}" r="20" fill="transparent"/>${shape}</g>`;
      if (Math.abs(g.m) < RANGE + 1) // a diverged Gaussian has no handles
        svg += handle("width", s, qx, qy,
          `<path d="M${qx} ${qy - 8}l8 8l-8 8l-8 -8Z" class="f-orange"/>`) +
          handle("position", g.m, px, py, `<circle cx="${px}" cy="${py}" r="7" class="f-orange"/>`);
    });
    const focused = document.activeElement?.dataset?.handle;
    signal.innerHTML = svg;
    if (focused) part(`[data-handle=${focused}]`)?.focus();
  }

  function drawLoss() {
    const x = i => 50 + i / STEPS * 270, y = e => 22 + -Math.log10(Math.max(e, 1e-4)) / 4 * 110;
    let svg = text(2, 12, say("relative error", "相对误差")) + text(320, 166, say("steps", "步数"), 'text-anchor="end"');
    [1, 0.1, 0.01, 0.001, 0.0001].forEach(e => {
      svg += curve(`M50 ${y(e)}H320`, "line", "", 1) +
        text(44, y(e) + 4, e, 'text-anchor="end"');
    });
    [0, STEPS / 2, STEPS].forEach(i => { svg += text(x(i), 150, i, 'text-anchor="middle"'); });
    const points = errors.map((e, i) => `${x(i).toFixed(1)} ${y(Math.min(e, 1.5)).toFixed(1)}`);
    if (points.length) svg += curve(`M${points.join("L")}`, "blue");
    lossPanel.innerHTML = svg + curve(`M50 ${y(FOUND)}H320`, "green", 'stroke-dasharray="4 4"');
  }

  function drawPull() {
    const g = fit.p[active], others = fit.p.filter(h => h !== g), t = targets(blurAt(fit));
    const pull = m => { const h = { ...g, m }; return -gradient(h, [...others, h], t).m; };
    const samples = Array.from({ length: 201 }, (_, i) => pull(-RANGE + i / 200 * 2 * RANGE));
    const top = Math.max(...samples.map(Math.abs)) || 1;
    const x = u => 58 + (u + RANGE) / (2 * RANGE) * 262, y = f => 77 - f / top * 52;
    let svg = text(2, 12, say("−∂L/∂μ by position μ: the pull", "−∂L/∂μ 随位置 μ 的变化：拉力")) + curve("M58 77H320", "line", "", 1);
    [top, 0, -top].forEach(v => {
      svg += text(52, y(v) + 4, signed((v < 0 ? "-" : "") + number(Math.abs(v))),
        'text-anchor="end"');
    });
    for (let u = -RANGE; u <= RANGE; u += 10)
      svg += text(x(u), 150, signed(u), 'text-anchor="middle"');
    svg += curve(line(x, y, -RANGE, RANGE, 200, pull), "violet");
    if (Math.abs(g.m) < RANGE)
      svg += `<circle cx="${x(g.m)}" cy="${y(pull(g.m))}" r="5" class="f-orange"/>`;
    pullPanel.innerHTML = svg;
  }

  function status() {
    const error = relativeError(fit.p), done = fit.step >= STEPS, g = fit.p[active];
    const pull = Math.abs(gradient(g, fit.p, targets(blurAt(fit))).m);
    root.dataset.result = !done ? "" : error < FOUND ? "found" : "not found";
    const words = !done ? "" : error < FOUND ? say(" The target is found.", "找到了目标。")
      : say(" The target is not found.", "没有找到目标。");
    const shown = number(Math.max(error, 1e-12));
    part(".status").textContent = say(`Step ${fit.step}: relative error ${shown}, |∂L/∂μ| = ${number(pull)}.`,
      `第 ${fit.step} 步：相对误差 ${shown}，|∂L/∂μ| = ${number(pull)}。`) + words;
    field("run").textContent = running ? say("Pause", "暂停") : say("Run", "运行");
  }
  const draw = () => { drawSignal(); drawLoss(); drawPull(); status(); };

  // The green strip: positions of the active Gaussian from which the complete fit is a success.
  let waiting = 0;
  function findBasin() {
    const options = settings();
    basin = Array.from({ length: 80 }, (_, i) => {
      const p = copy(start);
      p[active].m = -RANGE + (i + 0.5) / 40 * RANGE;
      const trial = begin(p);
      while (trial.step < STEPS) advance(trial, options);
      return relativeError(trial.p) < FOUND;
    });
    drawSignal();
  }
  function restart() {
    running = false;
    fit = begin(start);
    errors = [];
    draw();
    clearTimeout(waiting);
    waiting = setTimeout(findBasin, 60);
  }
  function choose() { // a new number of Gaussians, spread over the range
    const n = Number(field("count").value);
    start = Array.from({ length: n }, (_, i) => ({ m: -2.5 + 5 * i, l: 0, a: 0.6 }));
    active = 0;
    restart();
  }

  // Run
  const still = matchMedia("(prefers-reduced-motion: reduce)");
  function frame() {
    if (!running) return;
    const options = settings(), count = still.matches ? STEPS : 8;
    for (let i = 0; i < count && fit.step < STEPS; i++) {
      errors.push(relativeError(fit.p));
      advance(fit, options);
    }
    if (fit.step >= STEPS) { running = false; errors.push(relativeError(fit.p)); }
    draw();
    if (running) requestAnimationFrame(frame);
  }
  field("run").addEventListener("click", () => {
    if (fit.step >= STEPS) restart();
    running = !running;
    status();
    frame();
  });
  field("back").addEventListener("click", restart);
  for (const name of ["target", "optimiser", "blur", "noise"])
    field(name).addEventListener("change", restart);
  field("count").addEventListener("change", choose);

  // Handles: drag, or arrow keys. A change begins from what is shown.
  function change(handle, edit) {
    active = Number(handle.slice(-1));
    start = copy(fit.p);
    const g = start[active];
    edit(g, handle.startsWith("width"));
    g.m = Math.max(-RANGE, Math.min(RANGE, g.m));
    g.l = Math.max(Math.log(0.1), Math.min(Math.log(RANGE), g.l));
    restart();
  }
  let dragged = "";
  const position = event => {
    const box = signal.getBoundingClientRect();
    return ((event.clientX - box.left) / box.width * width - 8) / (width - 16) * 2 * RANGE - RANGE;
  };
  signal.addEventListener("pointerdown", event => {
    dragged = event.target.closest(".handle")?.dataset.handle || "";
    if (!dragged) return;
    event.preventDefault();
    signal.setPointerCapture(event.pointerId);
    part(`[data-handle=${dragged}]`).focus();
  });
  signal.addEventListener("pointermove", event => {
    if (dragged) change(dragged, (g, wide) => {
      if (wide) g.l = Math.log(Math.max(0.1, position(event) - g.m));
      else g.m = position(event);
    });
  });
  for (const end of ["pointerup", "pointercancel"])
    signal.addEventListener(end, () => { dragged = ""; });
  signal.addEventListener("keydown", event => {
    const handle = event.target.closest?.(".handle")?.dataset.handle;
    const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    if (!handle || !way) return;
    event.preventDefault();
    change(handle, (g, wide) => { if (wide) g.l += 0.1 * way; else g.m += 0.25 * way; });
  });
  new ResizeObserver(() => {
    if (Math.max(300, Math.min(700, root.clientWidth)) !== width) drawSignal();
  }).observe(root);
  document.getElementById("basin-picture")?.remove();
  choose();
})();
