// A picture fitted by 2D Gaussians in a worker, while the reader watches.
(() => {
  "use strict";
  const { add, choice, button, t, load, figure } = interactive;
  const LONGEST = 320, STEPS = 1500;

  function work() { // the worker; its messages: { step, count, psnr, pixels, rows, born, counts }
    const ROUNDS = 10, FIRST_SHARE = 0.15, GROWTH = 0.4, FRAME = 100; // ms between messages
    let fit, most, steps, spacing, round, paused = false, counts;
    function report() {
      const { rows, born, steps: step, count } = fit, image = fit.render();
      const pixels = new Uint8ClampedArray(4 * fit.width * fit.height);
      for (let p = 0, q = 0; q < pixels.length; p += 3, q += 4) {
        for (let c = 0; c < 3; c++) pixels[q + c] = 255 * image[p + c];
        pixels[q + 3] = 255;
      }
      postMessage({ step, count, psnr: -10 * Math.log10(fit.mse), pixels, rows, born, counts });
    }
    function advance() {
      const first = Math.round(FIRST_SHARE * most);
      for (const end = performance.now() + FRAME; performance.now() < end && fit.steps < steps;) {
        fit.step(0.5 + 0.5 * Math.cos(Math.PI * fit.steps / steps), spacing);
        if (round >= ROUNDS || fit.steps < (round + 1) * GROWTH * steps / ROUNDS) continue;
        round++;
        const wanted = first + Math.round((most - first) * round / ROUNDS);
        const now = fit.densify(fit.worst(wanted - fit.count), 0.8 * spacing, true);
        for (const kind of Object.keys(now)) counts[kind] += now[kind];
      }
      report();
      if (!paused && fit.steps < steps) setTimeout(advance);
    }
    onmessage = ({ data }) => {
      if (data.target) {
        fit = fitting2d(gaussians2d(data.target, data.width, data.height));
        ({ most, steps } = data);
        spacing = Math.sqrt(data.width * data.height / most);
        round = 0;
        counts = { cloned: 0, split: 0, pruned: 0 };
        fit.start(Math.max(1, Math.round(FIRST_SHARE * most)));
      }
      paused = data.paused;
      if (paused) report(); else setTimeout(advance);
    };
  }

  figure("fit", async ({ element, controls, panels, status }) => {
    await Promise.all(["gaussians2d.js", "fitting2d.js", "picture-data.js"].map(load));
    let worker = null, picture = null, latest = null, running = false, view = "image", problem = "";
    const pick = add(add(controls, "label", {}, `${t("Picture", "图片")} `), "input",
      { type: "file", accept: "image/*", name: "picture" });
    const most = choice(controls, "most", t("Gaussians", "高斯数"),
      [1000, 200, 500, 2000].map(n => [n, n]), restart);
    choice(controls, "view", t("Show", "显示"), [["image", t("the image", "图像")],
      ["ellipses", t("ellipses", "椭圆")], ["original", t("the picture", "原图")]],
    value => { view = value; draw(); });
    const buttons = add(controls, "span");
    const run = button(buttons, "run", "", () => {
      if (latest?.step === STEPS) return restart(), run.click();
      running = !running;
      problem = "";
      label();
      worker.postMessage({ paused: !running });
    });
    buttons.append(" ");
    button(buttons, "restart", t("Back to start", "恢复初始状态"), restart);
    const canvas = add(panels, "canvas", { class: "picture", role: "img",
      "aria-label": t("The picture, made of Gaussians", "由高斯组成的图片") });
    const context = canvas.getContext("2d");
    const label = () => { run.textContent = running ? t("Pause", "暂停") : t("Run", "运行"); };

    async function open(source) { // a Blob
      let bitmap;
      try {
        bitmap = await createImageBitmap(source);
      } catch {
        problem = t("This file is not a picture that the browser can read; choose a JPEG, PNG or WebP file.",
          "浏览器无法读取这个文件；请选择 JPEG、PNG 或 WebP 图片。");
        status.textContent = problem;
        return;
      }
      const scale = Math.min(1, LONGEST / Math.max(bitmap.width, bitmap.height));
      canvas.width = Math.max(1, Math.round(bitmap.width * scale));
      canvas.height = Math.max(1, Math.round(bitmap.height * scale));
      context.fillStyle = "white"; // behind transparent pixels
      context.fillRect(0, 0, canvas.width, canvas.height);
      context.imageSmoothingQuality = "high";
      context.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
      picture = context.getImageData(0, 0, canvas.width, canvas.height);
      restart();
    }
    function restart() {
      worker?.terminate();
      running = false;
      problem = "";
      label();
      const source = URL.createObjectURL(new Blob([`${gaussians2d}\n${fitting2d}\n(${work})();`]));
      worker = new Worker(source);
      URL.revokeObjectURL(source);
      worker.onmessage = ({ data }) => {
        latest = data;
        if (data.step === STEPS) { running = false; label(); }
        draw();
      };
      const { width, height } = picture, target = new Float32Array(3 * width * height);
      for (let p = 0; p < target.length; p++) target[p] = picture.data[4 * (p / 3 | 0) + p % 3] / 255;
      worker.postMessage({ target, width, height, most: Number(most.value), steps: STEPS, paused: true });
    }
    function draw() {
      if (!latest) return;
      const { rows, born, counts } = latest, { width, height } = picture;
      if (latest.pixels.length !== picture.data.length) return; // of the picture before
      context.putImageData(view === "original" ? picture : new ImageData(latest.pixels, width, height), 0, 0);
      if (view === "ellipses") {
        context.fillStyle = "#101418";
        context.fillRect(0, 0, width, height);
        for (let i = latest.count - 1; i >= 0; i--) {
          const [x, y, u, v, angle, r, g, b, logit] = rows.subarray(9 * i, 9 * i + 9);
          context.beginPath();
          context.ellipse(x, y, Math.exp(u), Math.exp(v), angle, 0, 2 * Math.PI);
          context.fillStyle = `rgb(${255 * r} ${255 * g} ${255 * b} / ${1 / (1 + Math.exp(-logit))})`;
          context.fill();
          context.lineWidth = 0.7;
          context.strokeStyle = ["rgb(255 255 255 / 0.25)", "#52cf9a", "#ffa355"][born[i]];
          context.stroke();
        }
      }
      element.dataset.step = latest.step;
      element.dataset.psnr = latest.psnr.toFixed(2);
      status.textContent = problem || (latest.step ? "" : t("Run it, or drop a picture of yours here. ",
        "点“运行”，或者把你自己的图片拖到这里。")) + t(
        `Step ${latest.step} of ${STEPS}: ${latest.count} Gaussians, PSNR ${latest.psnr.toFixed(2)} dB. ` +
        `Cloned ${counts.cloned}, split ${counts.split}, pruned ${counts.pruned}` +
        (view === "ellipses" ? "; green: cloned last, orange: split last." : "."),
        `第 ${latest.step} 步，共 ${STEPS} 步：${latest.count} 个高斯，PSNR ${latest.psnr.toFixed(2)} dB。` +
        `克隆 ${counts.cloned}，分裂 ${counts.split}，剪枝 ${counts.pruned}` +
        (view === "ellipses" ? "；绿色：上次克隆的，橙色：上次分裂的。" : "。"));
    }
    pick.addEventListener("change", () => { if (pick.files[0]) open(pick.files[0]); });
    element.addEventListener("dragover", event => event.preventDefault());
    element.addEventListener("drop", event => {
      event.preventDefault();
      if (event.dataTransfer.files[0]) open(event.dataTransfer.files[0]);
    });
    const bytes = Uint8Array.from(atob(interactive.picture), c => c.charCodeAt(0));
    await open(new Blob([bytes], { type: "image/webp" }));
  });
})();
