// Adam and density control for the Gaussians of gaussians2d.js. Also one function without others.
function fitting2d(fit, seed = 1) {
  const { COLUMNS, target, width, height } = fit;
  const BETA1 = 0.8, BETA2 = 0.98, EPS = 1e-12, SHRINK = 1.6, LEAST_SIGMA = 0.25, LEAST_LOGIT = -5.3;
  const MEAN_RATE = 0.033; // times the mean distance of the Gaussians
  let moments = [];
  Object.assign(fit, { steps: 0, born: new Uint8Array(0) });

  function random() { // uniform in 0..1 (mulberry32)
    let t = seed += 0x6D2B79F5;
    t = Math.imul(t ^ t >>> 15, t | 1);
    t ^= t + Math.imul(t ^ t >>> 7, t | 61);
    return ((t ^ t >>> 14) >>> 0) / 4294967296;
  }
  const normal = () => Math.sqrt(-2 * Math.log(1 - random())) * Math.cos(2 * Math.PI * random());

  // A step of Adam with the rates of `snowsplat image`; `rate` is a factor of all of them, and
  // `spacing` the mean distance of the Gaussians in pixels.
  fit.step = (rate, spacing) => {
    fit.render();
    const grads = fit.gradient(), [m, v] = moments, mean = MEAN_RATE * spacing, { rows } = fit;
    const rates = [mean, mean, 0.06, 0.06, 0.06, 0.04, 0.04, 0.04, 0.1];
    fit.steps++;
    const size = rate * Math.sqrt(1 - BETA2 ** fit.steps) / (1 - BETA1 ** fit.steps);
    for (let i = 0; i < grads.length; i++) {
      m[i] += (1 - BETA1) * (grads[i] - m[i]);
      v[i] += (1 - BETA2) * (grads[i] * grads[i] - v[i]);
      const j = i % COLUMNS, value = rows[i] - size * rates[j] * m[i] / (Math.sqrt(v[i]) + EPS);
      rows[i] = j === 2 || j === 3 ? Math.max(value, Math.log(LEAST_SIGMA))
        : j > 4 && j < 8 ? Math.min(Math.max(value, 0), 1) : value;
    }
  };

  // Replaces the rows: `parts` is a list of [row, number of the old row or -1, kind].
  function replace(parts) {
    const old = moments, n = parts.length * COLUMNS;
    fit.rows = new Float64Array(n);
    moments = [new Float64Array(n), new Float64Array(n)];
    fit.born = Uint8Array.from(parts, part => part[2]); // 0 kept, 1 cloned, 2 split
    parts.forEach(([row, from], i) => {
      fit.rows.set(row, i * COLUMNS);
      if (from >= 0) moments.forEach((list, j) =>
        list.set(old[j].subarray(from * COLUMNS, (from + 1) * COLUMNS), i * COLUMNS));
    });
    fit.count = parts.length;
    fit.slopes = new Float64Array(fit.count);
    fit.blame = new Float64Array(fit.count);
  }

  fit.start = count => { // at random places, with the colour of the picture there
    const sigma = Math.log(0.5 * Math.sqrt(width * height / count));
    replace(Array.from({ length: count }, () => {
      const x = random() * width, y = random() * height, p = 3 * ((y | 0) * width + (x | 0));
      return [[x, y, sigma, sigma, 0, target[p], target[p + 1], target[p + 2], 0], -1, 0];
    }));
  };

  fit.transparent = i => fit.rows[i * COLUMNS + 8] < LEAST_LOGIT; // opacity below 0.005
  fit.large = (i, size) =>
    Math.exp(Math.max(fit.rows[i * COLUMNS + 2], fit.rows[i * COLUMNS + 3])) > size;
  fit.worst = count => // the numbers of those with the largest error
    [...fit.blame.keys()].filter(i => !fit.transparent(i))
      .sort((i, j) => fit.blame[j] - fit.blame[i]).slice(0, Math.max(0, count));

  // Removes the transparent ones; of the chosen ones, clones those up to `size` and splits others.
  // A split `alongAxis` changes the image less than that of the paper: 33.8 instead of 33.1 dB with
  // 1000 Gaussians after 500 steps (the photo of picture-data.js, size 0.6 of their distance).
  fit.densify = (chosen, size, alongAxis = false) => {
    const set = new Set(chosen), counts = { cloned: 0, split: 0, pruned: 0 };
    replace(Array.from({ length: fit.count }, (_, i) => i).flatMap(i => {
      const r = Array.from(fit.rows.subarray(i * COLUMNS, (i + 1) * COLUMNS));
      if (fit.transparent(i)) { counts.pruned++; return []; }
      if (!set.has(i)) return [[r, i, 0]];
      const su = Math.exp(r[2]), sv = Math.exp(r[3]);
      if (!fit.large(i, size)) {
        counts.cloned++;
        const opacity = 1 / (1 + Math.exp(-r[8])), half = 1 - Math.sqrt(1 - opacity);
        r[8] = Math.log(half / (1 - half)); // together as opaque as before
        return [[r, -1, 1], [r, i, 1]];
      }
      counts.split++;
      const cos = Math.cos(r[4]), sin = Math.sin(r[4]), first = su > sv;
      return [-1, 1].map(side => {
        const child = [...r];
        let a = 0, b = 0; // the displacement, along the two axes
        if (alongAxis) {
          if (first) a = side * 0.6 * su; else b = side * 0.6 * sv;
          child[first ? 2 : 3] += Math.log(0.6);
        } else { // the rule of the paper
          a = su * normal();
          b = sv * normal();
          child[2] -= Math.log(SHRINK);
          child[3] -= Math.log(SHRINK);
        }
        child[0] += cos * a - sin * b;
        child[1] += sin * a + cos * b;
        return [child, -1, 2];
      });
    }));
    return counts;
  };
  return fit;
}
