// Projection: samples of a Gaussian, projected exactly, beside the ellipse of the approximation.
(() => {
  "use strict";
  const { slider, plot, path, ellipse, text, signed, t, figure } = interactive;
  figure("projection", ({ element, controls, panels, status }) => {
    const SAMPLES = 600, NEAR = 0.05, view = { x: 1.2, z: 3, s: 0.5, depth: 1 };
    // Points of a 3D normal distribution, in pairs ±u so that their mean is 0; the same in each view.
    let seed = 3;
    const uniform = () => ((seed = seed * 16807 % 2147483647) - 0.5) / 2147483646;
    const normal = () => Math.sqrt(-2 * Math.log(uniform())) * Math.cos(2 * Math.PI * uniform());
    const half = Array.from({ length: SAMPLES / 2 }, () => [normal(), normal(), normal()]);
    const samples = [...half, ...half.map(u => u.map(v => -v))];

    const top = plot(panels, t("The scene from above", "从上方看场景"), 330, 250, [-2.64, 2.64], [-0.2, 3.8]);
    const image = plot(panels, t("The image", "图像"), 330, 250, [-1.32, 1.32], [-1, 1]);
    slider(controls, "size", t("standard deviation s", "标准差 s"), [0.05, 1, 0.01, view.s],
      value => { view.s = value; draw(); });
    slider(controls, "depth", t("stretch along the depth", "沿深度方向拉伸"), [0.2, 3, 0.05, 1],
      value => { view.depth = value; draw(); });
    const move = (x, z) => {
      view.x = Math.min(2.5, Math.max(-2.5, x));
      view.z = Math.min(3.7, Math.max(0.3, z));
      draw();
    };

    function draw() {
      const { x, z, s } = view, deep = s * view.depth;
      // J (eq. 5) for f = 1 at (x, 0, z); the covariance is diag(s², s², deep²).
      const J = [[1 / z, 0, -x / (z * z)], [0, 1 / z, 0]];
      const M = [[Math.hypot(J[0][0] * s, J[0][2] * deep), 0], [0, J[1][1] * s]];
      const centre = [x / z, 0], points = [];
      let hidden = 0, inside = 0;
      const sums = [0, 0, 0, 0, 0];
      for (const [a, b, c] of samples) {
        const depth = z + deep * c;
        if (depth < NEAR) { hidden++; continue; }
        const u = (x + s * a) / depth, v = s * b / depth;
        points.push([u, v]);
        if (Math.hypot((u - centre[0]) / M[0][0], v / M[1][1]) <= 2) inside++;
        [u, v, u * u, u * v, v * v].forEach((value, i) => { sums[i] += value; });
      }
      const [mu, mv, uu, uv, vv] = sums.map(v => v / Math.max(points.length, 1));
      const a = Math.sqrt(Math.max(uu - mu * mu, 1e-12)), b = (uv - mu * mv) / a; // Cholesky
      const measured = [[a, 0], [b, Math.sqrt(Math.max(vv - mv * mv - b * b, 0))]];

      const at = (panel, list) => list.map(([u, v]) => [panel.X(u), panel.Y(v)]);
      const dots = (panel, list, radius) => `<path stroke-width="${2 * radius}" stroke-linecap="round"
        class="s-blue" stroke-opacity="0.55" d="${at(panel, list).map(([u, v]) =>
          `M${u.toFixed(1)} ${v.toFixed(1)}h0`).join("")}"/>`;
      const clipped = (list, [u, v]) => list.filter(p => Math.abs(p[0]) < u && Math.abs(p[1]) < v);
      top.draw(
        path(at(top, [[-2.64, 2], [0, 0], [2.64, 2]]), "line") +
        path(at(top, [[-1.32, 1], [1.32, 1]]), "soft") + path(at(top, [[0, 0], [x, z]]), "line") +
        dots(top, clipped(samples.map(([p, , q]) => [x + s * p, z + deep * q]), [2.64, 3.8]), 1) +
        path(at(top, ellipse([x, z], [[s, 0], [0, deep]])), "orange") +
        text(8, 14, t("from above; grey: the image plane z = 1", "从上方看；灰色：像平面 z = 1")) +
        text(top.X(0) + 8, top.Y(0) + 2, t("camera", "相机")),
        [{ name: "centre", label: t("Centre of the Gaussian", "高斯的中心"), at: [x, z], move }]);
      image.draw(
        dots(image, clipped(points, [1.32, 1]), 1) +
        [1, 2].map(k => path(at(image, ellipse(centre, M, k)), "orange") +
          path(at(image, ellipse([mu, mv], measured, k)), "green", 'stroke-dasharray="5 4"')).join("") +
        text(8, 14, t("the image; orange: approximation, dashed: samples", "图像；橙色：近似，虚线：样本")));
      const error = Math.hypot(mu - centre[0], mv) / M[0][0], share = inside / SAMPLES;
      element.dataset.share = share.toFixed(3);
      status.textContent = `J = (${signed(J[0][0])}, 0, ${signed(J[0][2])}; 0, ${signed(J[1][1])}, 0). ` +
        t(`Inside the ellipse k = 2: ${(100 * share).toFixed(1)}% of the samples (86.5% if the projection were affine). `,
          `椭圆 k = 2 内：${(100 * share).toFixed(1)}% 的样本（若投影是仿射的，应为 86.5%）。`) +
        t(`The mean of the samples is ${error.toFixed(2)} standard deviations away from the centre.`,
          `样本的均值距离中心 ${error.toFixed(2)} 个标准差。`) +
        (hidden ? t(` Behind the camera: ${hidden}.`, `位于相机后面：${hidden}。`) : "");
    }
    draw();
  });
})();
