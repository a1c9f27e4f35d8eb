// Density control step by step: a few 2D Gaussians and a picture of a ring and a dot.
(() => {
  "use strict";
  const { add, slider, button, plot, path, ellipse, t, load, figure } = interactive;
  figure("density", async ({ element, controls, panels, status }) => {
    await Promise.all(["gaussians2d.js", "fitting2d.js"].map(load));
    const SIZE = 64, STEPS = 100, START = 5, SMALL = 7; // SMALL: pixels, the limit of a clone
    const inside = v => Math.min(1, Math.max(0, v + 0.5)); // a soft edge of one pixel
    const target = new Float64Array(3 * SIZE * SIZE);
    for (let j = 0, p = 0; j < SIZE; j++) for (let i = 0; i < SIZE; i++, p += 3) {
      const x = i + 0.5 - 30, y = j + 0.5 - 34, ring = inside(4 - Math.abs(Math.hypot(x, y) - 19));
      const dot = inside(4 - Math.hypot(x - 22, y + 24));
      const share = Math.max(ring * inside(y + 8), dot), warm = dot > ring ? 1 : 0;
      [0.15, 0.45, 0.85].forEach((c, k) => {
        target[p + k] = 0.93 + share * ((warm ? [0.85, 0.35, 0.1][k] : c) - 0.93);
      });
    }
    let fit, stage, threshold = 0.15, before = 0, marks = [];
    const next = button(controls, "next", "", () => { advance(); draw(); });
    button(controls, "reset", t("Back to start", "恢复初始状态"), reset);
    slider(controls, "threshold", t("threshold of the gradient", "梯度阈值"),
      [0.05, 1, 0.01, threshold], value => { threshold = value; if (stage === "judged") judge(); draw(); });
    const canvases = [t("picture", "图片"), t("image of the Gaussians", "高斯的图像")].map(name => {
      const box = add(panels, "div", { class: "sphere" });
      const canvas = add(box, "canvas", { width: SIZE, height: SIZE, class: "tile", role: "img",
        "aria-label": name });
      add(box, "small", {}, name);
      return canvas;
    });
    const panel = plot(panels, t("The Gaussians as ellipses", "用椭圆表示的高斯"), 330, 330, [0, SIZE], [SIZE, 0]);
    const LABELS = { judge: t("Judge", "判断"), change: t("Clone, split, prune", "克隆、分裂、剪枝"),
      fit: t(`${STEPS} steps of Adam`, `${STEPS} 步 Adam`) };

    function reset() {
      fit = fitting2d(gaussians2d(target, SIZE, SIZE), 4);
      fit.start(START);
      before = 0;
      marks = [];
      stage = "changed";
      fit.render();
      draw(t("The start: five Gaussians at random places.", "起点：五个位置随机的高斯。"));
    }
    const slope = i => fit.slopes[i] / Math.max(1, fit.steps - before); // the mean over the steps
    function judge() {
      marks = Array.from({ length: fit.count }, (_, i) => (fit.transparent(i) ? "prune"
        : slope(i) < threshold ? "keep" : fit.large(i, SMALL) ? "split" : "clone"));
      stage = "judged";
    }
    let words = "";
    function advance() {
      words = "";
      if (stage === "changed") {
        const start = fit.mse;
        for (let i = 0; i < STEPS; i++) fit.step(0.25, 12);
        fit.render();
        words = t(`PSNR ${(-10 * Math.log10(start)).toFixed(1)} → ${(-10 * Math.log10(fit.mse)).toFixed(1)} dB.`,
          `PSNR 从 ${(-10 * Math.log10(start)).toFixed(1)} dB 变为 ${(-10 * Math.log10(fit.mse)).toFixed(1)} dB。`);
        marks = [];
        stage = "fitted";
      } else if (stage === "fitted") judge();
      else {
        const chosen = marks.flatMap((mark, i) => (mark === "split" || mark === "clone" ? [i] : []));
        const { cloned, split, pruned } = fit.densify(chosen, SMALL);
        marks = Array.from(fit.born, kind => ["keep", "clone", "split"][kind]);
        before = fit.steps;
        fit.render();
        words = t(`${cloned} cloned, ${split} split, ${pruned} removed: ${fit.count} Gaussians now.`,
          `克隆 ${cloned} 个，分裂 ${split} 个，移除 ${pruned} 个：现在有 ${fit.count} 个高斯。`);
        stage = "changed";
      }
    }
    function show(canvas, values) {
      const picture = new ImageData(SIZE, SIZE);
      for (let p = 0, q = 0; p < values.length; p += 3, q += 4)
        picture.data.set([255 * values[p], 255 * values[p + 1], 255 * values[p + 2], 255], q);
      canvas.getContext("2d").putImageData(picture, 0, 0);
    }
    function draw(message = words) {
      const { X, Y } = panel, colours = { keep: "soft", clone: "green", split: "orange", prune: "red" };
      show(canvases[0], target);
      show(canvases[1], fit.render());
      let svg = path([[X(0), Y(0)], [X(SIZE), Y(0)], [X(SIZE), Y(SIZE)], [X(0), Y(SIZE)], [X(0), Y(0)]], "line");
      for (let i = fit.count - 1; i >= 0; i--) {
        const [x, y, lu, lv, angle, r, g, b, logit] = fit.rows.subarray(9 * i, 9 * i + 9);
        const u = Math.exp(lu), v = Math.exp(lv), cos = Math.cos(angle), sin = Math.sin(angle);
        const outline = ellipse([x, y], [[cos * u, -sin * v], [sin * u, cos * v]]);
        svg += path(outline.map(p => [X(p[0]), Y(p[1])]), colours[marks[i]] ?? "soft",
          `style="fill:rgb(${[r, g, b].map(c => Math.round(255 * c)).join(" ")});fill-opacity:${
            (0.6 / (1 + Math.exp(-logit))).toFixed(2)}"`);
      }
      panel.draw(svg);
      const count = mark => marks.filter(m => m === mark).length;
      next.textContent = LABELS[{ changed: "fit", fitted: "judge", judged: "change" }[stage]];
      element.dataset.stage = stage;
      element.dataset.count = fit.count;
      status.textContent = stage === "judged"
        ? t(`Above the threshold: ${count("split")} large (orange, to be split), ${count("clone")} small (green, to be cloned). ` +
            `Transparent: ${count("prune")} (red).`,
          `超过阈值：${count("split")} 个大的（橙色，将分裂），${count("clone")} 个小的（绿色，将克隆）。` +
            `透明：${count("prune")} 个（红色）。`) : message;
    }
    reset();
  });
})();
