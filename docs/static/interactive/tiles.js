// Tiles, keys and sort: 64 splats of a real scene, with the lists that a rasterizer makes of them.
(() => {
  "use strict";
  const { add, slider, choice, plot, path, ellipse, eigen, t, load, figure } = interactive;
  figure("tiles", async ({ element, controls, panels, status }) => {
    await load("tiles-data.js");
    const TILE = 16, COLUMNS = 6, ROWS = 4, WIDTH = COLUMNS * TILE, HEIGHT = ROWS * TILE;
    const GRID = 'style="stroke:white;stroke-width:1;stroke-opacity:0.35"';
    const splats = interactive.tiles.map(([x, y, a, b, c, opacity, depth, ...colour], index) =>
      ({ x, y, a, b, c, opacity, depth, colour, index, reach: 2 * Math.log(255 * opacity) }));
    let stage = "sorted", rule = "exact", tile = 8, instances = [], count = 0;
    choice(controls, "stage", t("List", "列表"), [
      ["sorted", t("sorted by key", "按键排序")], ["made", t("as it is made", "生成时的顺序")],
    ], value => { stage = value; draw(); });
    choice(controls, "rule", t("Tiles of", "图块取自"), [
      ["exact", t("the ellipse", "椭圆")], ["box", t("its bounding box", "外接矩形")],
      ["square", t("a square of 3σ", "3σ 正方形")],
    ], value => { rule = value; count = Infinity; draw(); });
    const stop = slider(controls, "count", t("blended", "已混合"), [0, 1, 1, 1],
      value => { count = value; draw(); });
    const panel = plot(panels, t("Splats and tiles", "splat 与图块"), 330, 226, [0, WIDTH], [HEIGHT, 0],
      (x, y) => select(Math.floor(x / TILE), Math.floor(y / TILE)));
    const side = add(panels, "div", { class: "list" });
    const list = add(side, "pre", { class: "numbers", tabindex: 0,
      "aria-label": t("List of instances", "实例列表") });
    const picture = add(side, "canvas", { width: TILE, height: TILE, class: "tile", role: "img",
      "aria-label": t("The pixels of the tile", "图块的像素") });

    function select(column, row) {
      const inside = (v, count) => Math.min(count - 1, Math.max(0, v));
      const next = inside(row, ROWS) * COLUMNS + inside(column, COLUMNS);
      if (next === tile) return;
      tile = next;
      count = Infinity; // all instances
      draw();
    }
    const alpha = (s, dx, dy) =>
      s.opacity * Math.exp(-0.5 * (s.a * dx * dx + s.c * dy * dy) - s.b * dx * dy);
    // The least quadratic form dᵀ Σ'⁻¹ d over the pixel centres' rectangle: 0 inside, else on an edge.
    function nearest(s, [x0, x1], [y0, y1]) {
      const inside = (v, low, high) => Math.min(high, Math.max(low, v));
      if (x0 <= 0 && x1 >= 0 && y0 <= 0 && y1 >= 0) return 0;
      const form = (x, y) => s.a * x * x + 2 * s.b * x * y + s.c * y * y;
      return Math.min(...[x0, x1].map(x => form(x, inside(-s.b * x / s.c, y0, y1))),
        ...[y0, y1].map(y => form(inside(-s.b * y / s.a, x0, x1), y)));
    }
    function overlaps(s, column, row) {
      const x = [column * TILE + 0.5 - s.x, (column + 1) * TILE - 0.5 - s.x];
      const y = [row * TILE + 0.5 - s.y, (row + 1) * TILE - 0.5 - s.y];
      if (rule === "exact") return nearest(s, x, y) <= s.reach;
      const det = s.a * s.c - s.b * s.b; // Σ' = (c, -b; -b, a) / det
      const size = rule === "box"
        ? [s.c, s.a].map(v => Math.sqrt(s.reach * v / det))
        : new Array(2).fill(3 * Math.sqrt(eigen(s.c / det, -s.b / det, s.a / det)[0]));
      return x[1] >= -size[0] && x[0] <= size[0] && y[1] >= -size[1] && y[0] <= size[1];
    }
    function paint(canvas, left, top, list) { // composites splats, from front to back
      const context = canvas.getContext("2d"), pixels = context.createImageData(canvas.width, canvas.height);
      for (let j = 0, q = 0; j < canvas.height; j++) for (let i = 0; i < canvas.width; i++, q += 4) {
        let T = 1;
        const rgb = [0, 0, 0];
        for (const s of list) {
          const a = Math.min(0.99, alpha(s, left + i + 0.5 - s.x, top + j + 0.5 - s.y));
          if (a < 1 / 255) continue;
          if (T * (1 - a) < 1e-4) break;
          s.colour.forEach((c, k) => { rgb[k] += T * a * c; });
          T *= 1 - a;
        }
        pixels.data.set([...rgb.map(c => 255 * c), 255], q);
      }
      context.putImageData(pixels, 0, 0);
    }
    const whole = document.createElement("canvas");
    whole.width = WIDTH;
    whole.height = HEIGHT;
    paint(whole, 0, 0, [...splats].sort((p, q) => p.depth - q.depth));
    const image = whole.toDataURL();
    const bits = new DataView(new ArrayBuffer(4)); // of a float32: in the order of the number
    const key = (number, depth) => {
      bits.setFloat32(0, depth);
      return BigInt(number) << 32n | BigInt(bits.getUint32(0));
    };
    function draw() {
      instances = splats.flatMap(s => Array.from({ length: COLUMNS * ROWS }, (_, i) => i)
        .filter(i => overlaps(s, i % COLUMNS, Math.floor(i / COLUMNS)))
        .map(i => ({ s, tile: i, key: key(i, s.depth) })));
      if (stage === "sorted") instances.sort((p, q) => (p.key < q.key ? -1 : p.key > q.key ? 1 : 0));
      const mine = instances.filter(i => i.tile === tile).sort((p, q) => p.s.depth - q.s.depth);
      count = Math.min(count, mine.length);
      stop.max = mine.length;
      stop.value = count;
      const column = tile % COLUMNS, row = Math.floor(tile / COLUMNS), { X, Y } = panel;
      const shown = new Set(mine.map(i => i.s)), wide = X(TILE) - X(0);
      let svg = `<image href="${image}" x="${X(0)}" y="${Y(0)}" width="${X(WIDTH) - X(0)}"
        height="${Y(HEIGHT) - Y(0)}" preserveAspectRatio="none"/><rect x="${X(column * TILE)}" y="${Y(row * TILE)}" width="${wide}" height="${wide}"
        fill="none" stroke="white" stroke-width="2"/>`;
      for (let i = 0; i <= COLUMNS; i++) svg += path([[X(i * TILE), Y(0)], [X(i * TILE), Y(HEIGHT)]], "", GRID);
      for (let i = 0; i <= ROWS; i++) svg += path([[X(0), Y(i * TILE)], [X(WIDTH), Y(i * TILE)]], "", GRID);
      for (const s of [...splats].reverse()) {
        const det = s.a * s.c - s.b * s.b, [u, v, angle] = eigen(s.c / det, -s.b / det, s.a / det);
        const [p, q] = [u, v].map(e => Math.sqrt(e * s.reach)), cos = Math.cos(angle), sin = Math.sin(angle);
        const outline = ellipse([s.x, s.y], [[cos * p, -sin * q], [sin * p, cos * q]]);
        svg += path(outline.map(([x, y]) => [X(x), Y(y)]), "", `style="stroke:${shown.has(s)
          ? "#ffa355" : "white"};stroke-width:${shown.has(s) ? 1.2 : 0.5};stroke-opacity:0.6"`);
      }
      panel.draw(svg, [{ name: "tile", label: t("Tile", "图块"), text: String(tile), colour: "blue",
        at: [(column + 0.5) * TILE, (row + 0.5) * TILE],
        move: (x, y, way) => {
          if (way) select(column + way[0], row - way[1]);
          else select(Math.floor(x / TILE), Math.floor(y / TILE));
        } }]);
      const first = instances.findIndex(i => i.tile === tile);
      list.textContent = `${t("tile | depth  key", "图块 | 深度   键")}\n` + instances.map(i =>
        `${i.tile === tile ? "▸" : " "} ${String(i.tile).padStart(2)} | ${i.s.depth.toFixed(3)} ` +
        `${i.key.toString(16).padStart(10, "0")}`).join("\n");
      list.scrollTop = Math.max(0, first) * parseFloat(getComputedStyle(list).lineHeight);
      paint(picture, column * TILE, row * TILE, mine.slice(0, count).map(i => i.s));
      element.dataset.instances = instances.length;
      element.dataset.range = stage === "sorted" && mine.length ? `${first},${first + mine.length - 1}` : "";
      status.textContent = t(`${splats.length} splats, ${instances.length} instances. Tile ${tile}: ${mine.length} instances`,
        `${splats.length} 个 splat，${instances.length} 个实例。图块 ${tile}：${mine.length} 个实例`) +
        (element.dataset.range ? t(`, from ${first} to ${first + mine.length - 1} of the sorted list.`,
          `，位于排序后列表的第 ${first} 到 ${first + mine.length - 1} 项。`)
          : t(", scattered over the list until it is sorted.", "，在排序之前分散在列表中。"));
    }
    count = Infinity;
    draw();
  });
})();
