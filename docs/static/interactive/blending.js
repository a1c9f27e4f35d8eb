// Blending: layers on a ray, their transmittance and weights, in any order.
(() => {
  "use strict";
  const { add, choice, tick, button, plot, path, text, signed, t, figure } = interactive;
  figure("blending", ({ element, controls, panels, status }) => {
    const COLOURS = [[214, 69, 65], [60, 140, 220], [242, 183, 5], [72, 160, 90]];
    const START = [[2, 0.6], [4, 0.5], [6, 0.8], [8, 0.9]];
    let layers, sorted = true, background = 255;
    const names = [t("red", "红"), t("blue", "蓝"), t("yellow", "黄"), t("green", "绿")];
    choice(controls, "background", t("Background", "背景"),
      [[255, t("white", "白")], [0, t("black", "黑")]], value => { background = Number(value); draw(); });
    tick(controls, "sorted", t("sort by depth", "按深度排序"), on => { sorted = on; draw(); }, true);
    const buttons = add(controls, "span");
    button(buttons, "reverse", t("Reverse the depths", "反转深度"), () => {
      for (const layer of layers) layer.s = 10 - layer.s;
      draw();
    });
    buttons.append(" ");
    button(buttons, "reset", t("Back to start", "恢复初始状态"), reset);
    const panel = plot(panels, t("Opacity and transmittance along a ray", "沿光线的不透明度和透射率"), 400, 230,
      [0, 10], [-0.12, 1.2]);
    const table = add(panels, "table");

    function reset() {
      layers = START.map(([s, alpha], i) => ({ s, alpha, i }));
      draw();
    }
    function draw() {
      // The rule of the page: C = Σ T α c, T = Π (1 - α), in the order of the list.
      const order = sorted ? [...layers].sort((p, q) => p.s - q.s) : layers;
      const colour = [0, 0, 0], css = c => `rgb(${c.map(Math.round).join(" ")})`;
      let T = 1;
      const rows = order.map(layer => {
        const weight = T * layer.alpha, before = T;
        COLOURS[layer.i].forEach((c, j) => { colour[j] += weight * c; });
        T -= weight;
        return { layer, before, weight };
      });
      for (let j = 0; j < 3; j++) colour[j] += T * background;

      const { X, Y } = panel;
      let svg = path([[X(0), Y(0)], [X(10), Y(0)]], "line") + path([[X(0), Y(1)], [X(10), Y(1)]], "line");
      for (const { layer, weight } of rows) {
        const bell = Array.from({ length: 61 }, (_, i) => {
          const u = layer.s - 1.5 + i / 20, G = Math.exp(-((u - layer.s) ** 2) / 0.32);
          return [X(Math.min(10, Math.max(0, u))), Y(layer.alpha * G)];
        });
        svg += `<path d="M${bell.map(p => p.join(" ")).join("L")}Z" fill="${css(COLOURS[layer.i])}"
          fill-opacity="0.3"/><rect x="${X(layer.s) - 5}" width="10" y="${Y(weight)}"
          height="${Y(0) - Y(weight)}" fill="${css(COLOURS[layer.i])}"/>`;
      }
      if (sorted) { // T as a function of the depth exists only in the order of depth
        const steps = [[0, 1]];
        for (const { layer, before, weight } of rows)
          steps.push([layer.s, before], [layer.s, before - weight]);
        svg += path([...steps, [10, T]].map(([u, v]) => [X(u), Y(v)]), "ink");
      }
      svg += text(8, 14, t("bells: α, bars: weights T α, line: transmittance T",
        "钟形：α，柱：权重 T α，折线：透射率 T")) +
        text(8, 226, t("eye", "眼睛")) + text(392, 226, t("depth →", "深度 →"), 'text-anchor="end"');
      panel.draw(svg, layers.map(layer => ({
        name: `layer${layer.i}`, label: names[layer.i], at: [layer.s, layer.alpha], colour: "ink",
        text: `${t("depth", "深度")} ${layer.s.toFixed(1)}, α ${layer.alpha.toFixed(2)}`,
        move(s, alpha) {
          layer.s = Math.min(9.8, Math.max(0.2, s));
          layer.alpha = Math.min(0.99, Math.max(0, alpha));
          draw();
        },
      })));
      table.replaceChildren();
      const line = (cells, tag) => {
        const row = add(table, "tr");
        for (const cell of cells) add(row, tag, {}, cell);
        return row;
      };
      line([t("layer", "层"), "α", "T", "T α"], "th");
      for (const { layer, before, weight } of rows)
        line([names[layer.i], ...[layer.alpha, before, weight].map(v => signed(v))], "td");
      line([t("background", "背景"), "", signed(T), signed(T)], "td");
      const pixel = add(line([t("pixel", "像素"), "", ""], "td"), "td");
      pixel.style.background = css(colour);
      element.dataset.colour = colour.map(Math.round).join(",");
      status.textContent = t("Drag a circle: depth and opacity. ", "拖动圆点：深度和不透明度。") + (sorted
        ? t("The weights and the background add up to 1.", "各个权重与背景之和等于 1。")
        : t("Not sorted: the order of the list is used, and a far layer can cover a near one.",
          "未排序：使用列表的顺序，远处的层可能遮住近处的层。"));
    }
    reset();
  });
})();
