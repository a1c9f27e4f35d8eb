// Covariance: from scales and rotation, or from the three numbers of the matrix.
(() => {
  "use strict";
  const { slider, choice, plot, path, ellipse, eigen, text, signed, t, figure } = interactive;
  figure("covariance", ({ element, controls, panels, status }) => {
    const shape = { s1: 2, s2: 0.8, angle: 30 }, entries = { a: 3.16, b: 1.455, c: 1.48 };
    let stored = "factors";
    const panel = plot(panels, t("The ellipse of a covariance", "协方差的椭圆"), 330, 330,
      [-4.2, 4.2], [-4.2, 4.2]);
    const numbers = interactive.add(panels, "pre", { class: "numbers" });
    choice(controls, "stored", t("Stored numbers", "存储的数"), [
      ["factors", t("scales and rotation", "尺度和旋转")], ["entries", t("entries of Σ", "Σ 的元素")],
    ], value => {
      stored = value;
      const [a, b, c] = covariance();
      Object.assign(entries, { a, b, c }); // changing the description does not change the ellipse
      show();
    });
    const inputs = {};
    const input = (name, label, range, object) => {
      inputs[name] = slider(controls, name, label, range, value => { object[name] = value; draw(); });
    };
    input("s1", "s₁", [0.1, 3.5, 0.01, 2], shape);
    input("s2", "s₂", [0.1, 3.5, 0.01, 0.8], shape);
    input("angle", t("angle", "角度"), [-180, 180, 1, 30], shape);
    input("a", "Σ₁₁", [0.05, 9, 0.01, 3], entries);
    input("b", "Σ₁₂", [-5, 5, 0.01, 1], entries);
    input("c", "Σ₂₂", [0.05, 9, 0.01, 1], entries);

    const turn = () => [Math.cos, Math.sin].map(f => f(shape.angle * Math.PI / 180));
    function factor() { // M = R S
      const [cos, sin] = turn();
      return [[cos * shape.s1, -sin * shape.s2], [sin * shape.s1, cos * shape.s2]];
    }
    function covariance() { // Σ = M Mᵀ
      if (stored === "entries" && element.dataset.stored === "entries")
        return [entries.a, entries.b, entries.c];
      const [[a, b], [c, d]] = factor();
      return [a * a + b * b, a * c + b * d, c * c + d * d];
    }
    function show() {
      if (stored === "factors" && element.dataset.stored === "entries") {
        const [first, second, angle] = eigen(entries.a, entries.b, entries.c);
        shape.s1 = Math.sqrt(Math.max(first, 0.01));
        shape.s2 = Math.sqrt(Math.max(second, 0.01));
        shape.angle = angle * 180 / Math.PI;
      }
      element.dataset.stored = stored;
      for (const name of ["s1", "s2", "angle"]) inputs[name].parentNode.hidden = stored === "entries";
      for (const name of ["a", "b", "c"]) inputs[name].parentNode.hidden = stored === "factors";
      draw();
    }
    function axis(scale, turned) { // a handle at the end of an axis
      const [cos, sin] = turn(), u = turned ? [-sin, cos] : [cos, sin];
      return { name: scale, label: t("End of axis ", "轴的端点 ") + (turned ? 2 : 1),
        at: u.map(v => v * shape[scale]), colour: turned ? "green" : "orange",
        move(x, y) {
          shape[scale] = Math.min(3.5, Math.max(0.1, Math.hypot(x, y)));
          const angle = Math.atan2(y, x) * 180 / Math.PI - (turned ? 90 : 0);
          shape.angle = Math.round((angle + 540) % 360 - 180);
          draw();
        } };
    }
    function draw() {
      for (const name of ["s1", "s2", "angle"]) inputs[name].value = shape[name];
      for (const name of ["a", "b", "c"]) inputs[name].value = entries[name];
      const [a, b, c] = covariance(), [first, second, angle] = eigen(a, b, c), { X, Y } = panel;
      const at = points => points.map(([x, y]) => [X(x), Y(y)]), factors = stored === "factors";
      let svg = path(at([[-4.2, 0], [4.2, 0]]), "line") + path(at([[0, -4.2], [0, 4.2]]), "line");
      const valid = second > 0;
      if (valid) {
        const u = Math.sqrt(first), v = Math.sqrt(second), cos = Math.cos(angle), sin = Math.sin(angle);
        const M = [[cos * u, -sin * v], [sin * u, cos * v]];
        svg += path(at(ellipse([0, 0], M)), "blue", 'style="fill:var(--draw-blue);fill-opacity:0.15"') +
          path(at(ellipse([0, 0], M, 2)), "blue", 'stroke-dasharray="4 4"');
        const [[m11, m12], [m21, m22]] = factors ? factor() : M;
        svg += path(at([[0, 0], [m11, m21]]), "orange") + path(at([[0, 0], [m12, m22]]), "green");
      }
      panel.draw(svg + text(8, 14, t("solid: k = 1, dashed: k = 2", "实线：k = 1，虚线：k = 2")),
        factors ? [axis("s1", false), axis("s2", true)] : []);
      const [cos, sin] = turn(), row = (...v) => v.map(x => signed(x).padStart(6)).join(" ");
      numbers.textContent = (factors
        ? `R = ${row(cos, -sin)}\n    ${row(sin, cos)}\n\nS = ${row(shape.s1, 0)}\n    ${row(0, shape.s2)}\n\n` : "") +
        `Σ = ${row(a, b)}\n    ${row(b, c)}\n\n${t("eigenvalues", "特征值")}\n    ${row(first, second)}\n` +
        `det Σ = ${signed(a * c - b * b)}`;
      element.dataset.valid = valid;
      status.textContent = !valid
        ? t("One eigenvalue is not positive: this matrix is not a covariance, and there is no ellipse.",
          "有一个特征值不是正数：这个矩阵不是协方差，没有椭圆。")
        : factors ? t("Every value of the sliders gives a covariance. The eigenvalues are s₁² and s₂².",
          "滑块的每个取值都给出一个协方差。特征值是 s₁² 和 s₂²。")
          : t("Move Σ₁₂: beyond √(Σ₁₁Σ₂₂), the matrix is no covariance.",
            "移动 Σ₁₂：超过 √(Σ₁₁Σ₂₂) 时，矩阵不再是协方差。");
    }
    show();
  });
})();
