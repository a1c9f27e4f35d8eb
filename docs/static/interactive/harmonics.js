// Spherical harmonics: a function on the sphere, and its approximation degree by degree.
(() => {
  "use strict";
  const { add, basis, choice, signed, t, figure } = interactive;
  // Directions that are evenly distributed (a Fibonacci lattice), for integrals over the sphere.
  const COUNT = 4000, lattice = Array.from({ length: COUNT }, (_, i) => {
    const z = 1 - (2 * i + 1) / COUNT, r = Math.sqrt(1 - z * z), a = i * Math.PI * (3 - Math.sqrt(5));
    return [r * Math.cos(a), r * Math.sin(a), z];
  });
  const lobe = (d, x, y, z, width) => Math.exp((d[0] * x + d[1] * y + d[2] * z - 1) / width);
  const targets = {
    soft: d => 0.25 + 0.7 * lobe(d, 0.36, -0.8, 0.48, 0.25),
    sharp: d => 0.25 + 0.7 * lobe(d, 0.36, -0.8, 0.48, 0.03),
    two: d => 0.2 + 0.6 * lobe(d, 0.6, -0.64, 0.48, 0.08) + 0.5 * lobe(d, -0.8, -0.6, 0, 0.08),
    edge: d => (d[2] > 0.2 ? 0.8 : 0.2),
  };

  figure("harmonics", ({ element, controls, panels, status }) => {
    const SIZE = 150;
    let degree = 3, target = targets.soft, turn = 0, tilt = 0.3, h = [];
    choice(controls, "target", t("Function", "函数"), [
      ["soft", t("a soft highlight", "柔和的高光")], ["sharp", t("a narrow highlight", "窄的高光")],
      ["two", t("two highlights", "两处高光")], ["edge", t("an edge", "一条边界")],
      ["own", t("own coefficients", "自定系数")],
    ], value => { target = targets[value] ?? null; project(); });
    const degrees = choice(controls, "degree", t("Degrees up to", "最高阶数"),
      [3, 2, 1, 0].map(l => [l, l]), value => { degree = Number(value); draw(); });

    const spheres = [t("function", "函数"), t("approximation", "近似")].map(name => {
      const box = add(panels, "div", { class: "sphere" });
      const canvas = add(box, "canvas", { width: SIZE, height: SIZE, tabindex: 0, role: "img",
        "aria-label": `${name}; ${t("turn it with the arrow keys", "用方向键转动")}` });
      add(box, "small", {}, name);
      canvas.addEventListener("keydown", event => {
        const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
        if (!way) return;
        event.preventDefault();
        rotate(way[0] * 0.15, way[1] * 0.15);
      });
      let [x, y] = [0, 0]; // not movementX: browsers disagree about its unit, and about touch
      canvas.addEventListener("pointerdown", event => {
        canvas.setPointerCapture(event.pointerId);
        [x, y] = [event.clientX, event.clientY];
      });
      canvas.addEventListener("pointermove", event => {
        if (!canvas.hasPointerCapture(event.pointerId)) return;
        rotate((event.clientX - x) / 60, (event.clientY - y) / 60);
        [x, y] = [event.clientX, event.clientY];
      });
      return canvas;
    });
    const rotate = (right, up) => {
      turn += right;
      tilt = Math.max(-1.5, Math.min(1.5, tilt + up));
      draw();
    };
    // One slider for each coefficient, a row for each degree.
    const bars = add(panels, "div", { class: "coefficients" });
    const inputs = [0, 1, 2, 3].flatMap(l => {
      const row = add(bars, "div");
      add(row, "small", {}, `l = ${l}`);
      return Array.from({ length: 2 * l + 1 }, (_, i) => {
        const k = l * l + i, name = `l = ${l}, m = ${i - l}`;
        const input = add(row, "input", { type: "range", name: `h${k}`, min: -2, max: 2, step: 0.01,
          "aria-label": name, title: name });
        input.addEventListener("input", () => {
          h[k] = Number(input.value);
          target = null;
          controls.querySelector("[name=target]").value = "own";
          draw();
        });
        return input;
      });
    });

    function project() { // the coefficients are integrals, because the basis is orthonormal
      if (target) {
        h = new Array(16).fill(0);
        for (const d of lattice) {
          const value = (target(d) - 0.5) * 4 * Math.PI / COUNT;
          basis(...d).forEach((y, k) => { h[k] += value * y; });
        }
      }
      draw();
    }
    const approximation = (d, count) => {
      const y = basis(...d);
      let sum = 0.5; // as in the colour of a Gaussian
      for (let k = 0; k < count; k++) sum += h[k] * y[k];
      return sum;
    };
    function paint(canvas, f) {
      const context = canvas.getContext("2d"), picture = context.createImageData(SIZE, SIZE);
      const [c, s, ct, st] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
      for (let j = 0; j < SIZE; j++) for (let i = 0; i < SIZE; i++) {
        const u = (2 * i + 1) / SIZE - 1, v = 1 - (2 * j + 1) / SIZE, w2 = 1 - u * u - v * v;
        if (w2 < 0) continue;
        const w = -Math.sqrt(w2); // towards the eye is -y; tilt about u, then turn about z
        const y = w * ct + v * st, z = v * ct - w * st, q = 4 * (j * SIZE + i);
        const value = 255 * Math.min(1, Math.max(0, f([c * u + s * y, -s * u + c * y, z])));
        picture.data.set([value, value * 0.93, value * 0.8, 255], q);
      }
      context.putImageData(picture, 0, 0);
    }
    function draw() {
      const count = (degree + 1) ** 2;
      paint(spheres[0], target ?? (d => approximation(d, 16)));
      paint(spheres[1], d => approximation(d, count));
      inputs.forEach((input, k) => {
        input.value = h[k];
        input.disabled = k >= count;
        input.setAttribute("aria-valuetext", signed(h[k]));
      });
      let square = 0, mean = 0, all = 0;
      for (const d of lattice) {
        const value = target ? target(d) : approximation(d, 16);
        square += (value - approximation(d, count)) ** 2;
        mean += value;
        all += value * value;
      }
      const variance = all / COUNT - (mean / COUNT) ** 2;
      const rest = 100 * square / COUNT / Math.max(variance, 1e-9);
      element.dataset.rest = rest.toFixed(2);
      degrees.value = degree;
      status.textContent = t(
        `${count} coefficients. ${rest.toFixed(1)}% of the variance of the function is missing.`,
        `${count} 个系数。函数方差的 ${rest.toFixed(1)}% 没有被表示出来。`);
    }
    project();
  });
})();
