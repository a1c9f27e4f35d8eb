// 2D Gaussians: the image and its gradients; fitting2d.js uses them.
// It is one function that uses no other, because the live fit sends its text to a worker.
// A row of `rows`: x, y, log σ₁, log σ₂, angle, red, green, blue, logit of the opacity; the first
// row is in front. The order is fixed, so no tiles are needed: each Gaussian visits its own pixels,
// and the image stores the state of each pixel (T and the colour behind).
function gaussians2d(target, width, height) {
  const COLUMNS = 9, LEAST_ALPHA = 1 / 255, MOST_ALPHA = 0.99, LEAST_T = 1e-4;
  const pixels = width * height;
  const T = new Float64Array(pixels), last = new Int32Array(pixels);
  const image = new Float64Array(3 * pixels), behind = new Float64Array(3 * pixels), error = new Float64Array(3 * pixels);
  const background = [0, 1, 2].map(c => {
    let sum = 0;
    for (let p = c; p < 3 * pixels; p += 3) sum += target[p];
    return sum / pixels;
  });
  // slopes and blame: sums since the last change of the rows, of the gradients of the positions and
  // of the squared errors of the pixels, by blending weight.
  const fit = { COLUMNS, target, width, height, rows: new Float64Array(0), count: 0, mse: NaN,
    slopes: new Float64Array(0), blame: new Float64Array(0) };

  // The pixels of a Gaussian with α ≥ 1/255: returns the number of rows of pixels, each with seven
  // numbers in `span`: first pixel, end, α there, ratio, factor, dx, dy. Along a row the exponent is
  // quadratic, so α is multiplied by a ratio that is itself multiplied by a constant factor: there
  // is no exponential for each pixel. `shape` is the conic and what it is made of.
  const span = new Float64Array(7 * height), shape = {};
  function visit(i) {
    const r = fit.rows, k = i * COLUMNS, opacity = 1 / (1 + Math.exp(-r[k + 8]));
    const cos = Math.cos(r[k + 4]), sin = Math.sin(r[k + 4]);
    const u = Math.exp(-2 * r[k + 2]), v = Math.exp(-2 * r[k + 3]);
    const a = cos * cos * u + sin * sin * v, b = cos * sin * (u - v);
    const c = sin * sin * u + cos * cos * v, x = r[k], y = r[k + 1];
    Object.assign(shape, { a, b, c, cos, sin, u, v, opacity });
    if (opacity < LEAST_ALPHA) return 0;
    const reach = 2 * Math.log(opacity / LEAST_ALPHA), high = Math.sqrt(reach * a / (u * v));
    const factor = Math.exp(-a), bottom = Math.min(height - 1, Math.floor(y + high - 0.5));
    let rows = 0;
    for (let j = Math.max(0, Math.ceil(y - high - 0.5)); j <= bottom; j++) {
      const dy = j + 0.5 - y, middle = x - b * dy / a - 0.5;
      const half = Math.sqrt(Math.max(0, (reach - u * v / a * dy * dy) / a));
      const from = Math.max(0, Math.ceil(middle - half));
      const to = Math.min(width - 1, Math.floor(middle + half)), dx = from + 0.5 - x, m = 7 * rows;
      if (from > to) continue;
      span[m] = j * width + from; span[m + 1] = j * width + to + 1;
      span[m + 2] = opacity * Math.exp(-0.5 * (a * dx + 2 * b * dy) * dx - 0.5 * c * dy * dy);
      span[m + 3] = Math.exp(-a * (dx + 0.5) - b * dy); span[m + 4] = factor;
      span[m + 5] = dx; span[m + 6] = dy;
      rows++;
    }
    return rows;
  }

  function compositeOne(i, rows, red, green, blue) {
    for (let m = 0; m < 7 * rows; m += 7) {
      let value = span[m + 2], ratio = span[m + 3];
      const end = span[m + 1] | 0, factor = span[m + 4];
      for (let p = span[m] | 0; p < end; p++, value *= ratio, ratio *= factor) {
        if (last[p] < i) continue;
        const t = T[p], w = t * (value < MOST_ALPHA ? value : MOST_ALPHA), q = 3 * p;
        if (t - w < LEAST_T) { last[p] = i - 1; continue; }
        image[q] += w * red; image[q + 1] += w * green; image[q + 2] += w * blue;
        T[p] = t - w;
      }
    }
  }
  fit.render = () => { // fit.mse; returns the image (H, W, 3), composited from front to back
    T.fill(1); image.fill(0); last.fill(fit.count);
    for (let i = 0, k = 0; i < fit.count; i++, k += COLUMNS)
      compositeOne(i, visit(i), fit.rows[k + 5], fit.rows[k + 6], fit.rows[k + 7]);
    let sum = 0;
    for (let p = 0, q = 0; p < pixels; p++) for (let c = 0; c < 3; c++, q++) {
      const e = (image[q] += T[p] * background[c]) - target[q];
      error[q] = e; sum += e * e;
    }
    fit.mse = sum / (3 * pixels);
    return image;
  };

  // From back to front, B is the colour behind a Gaussian: ∂C/∂α = T (c - B), and B becomes
  // α c + (1 - α) B. The sums of the pixels become the gradients of the nine parameters.
  function gradientOne(i, rows, red, green, blue, grads, k) {
    let gr = 0, gg = 0, gb = 0, h = 0, hx = 0, hy = 0, hxx = 0, hxy = 0, hyy = 0, share = 0;
    for (let m = 0; m < 7 * rows; m += 7) {
      let value = span[m + 2], ratio = span[m + 3], dx = span[m + 5], s = 0, sx = 0, sxx = 0;
      const end = span[m + 1] | 0, factor = span[m + 4], dy = span[m + 6];
      for (let p = span[m] | 0; p < end; p++, dx++, value *= ratio, ratio *= factor) {
        if (last[p] < i) continue;
        const q = 3 * p, alpha = value < MOST_ALPHA ? value : MOST_ALPHA;
        const t = T[p] / (1 - alpha), w = t * alpha, er = error[q], eg = error[q + 1];
        const eb = error[q + 2], br = behind[q], bg = behind[q + 1], bb = behind[q + 2];
        gr += w * er; gg += w * eg; gb += w * eb;
        share += w * (er * er + eg * eg + eb * eb);
        if (value < MOST_ALPHA) {
          const d = w * (er * (red - br) + eg * (green - bg) + eb * (blue - bb));
          s += d; sx += d * dx; sxx += d * dx * dx;
        }
        T[p] = t;
        behind[q] = br + alpha * (red - br);
        behind[q + 1] = bg + alpha * (green - bg);
        behind[q + 2] = bb + alpha * (blue - bb);
      }
      h += s; hx += sx; hy += s * dy; hxx += sxx; hxy += sx * dy; hyy += s * dy * dy;
    }
    const { a, b, c, cos, sin, u, v, opacity } = shape;
    grads[k] = a * hx + b * hy;
    grads[k + 1] = b * hx + c * hy;
    grads[k + 2] = u * (cos * cos * hxx + 2 * cos * sin * hxy + sin * sin * hyy);
    grads[k + 3] = v * (sin * sin * hxx - 2 * cos * sin * hxy + cos * cos * hyy);
    grads[k + 4] = (u - v) * (cos * sin * (hxx - hyy) - (cos * cos - sin * sin) * hxy);
    grads[k + 5] = gr; grads[k + 6] = gg; grads[k + 7] = gb;
    grads[k + 8] = h * (1 - opacity);
    fit.slopes[i] += Math.hypot(grads[k], grads[k + 1]);
    fit.blame[i] += share;
  }
  fit.gradient = () => { // of ½ Σ error², as `rows`; call render() before
    const grads = new Float64Array(fit.rows.length);
    for (let p = 0; p < 3 * pixels; p += 3) behind.set(background, p);
    for (let i = fit.count - 1, k = i * COLUMNS; i >= 0; i--, k -= COLUMNS) {
      const rows = visit(i);
      gradientOne(i, rows, fit.rows[k + 5], fit.rows[k + 6], fit.rows[k + 7], grads, k);
    }
    return grads;
  };
  return fit;
}
