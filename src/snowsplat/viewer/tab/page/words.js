// The texts of the page in its two languages. {name} is replaced by a value.

/** @type {Record<string, Record<string, string>>} */
const WORDS = {
    en: {
        other: "中文",
        scene: "Scene",
        training: "Training",
        progress: "Finished share of the steps",
        about: "These photos become a scene in 3D now, on this computer. Nothing is sent anywhere.",
        reading: "Reading photo {number} of {photos} …",
        preparing: "Preparing kernel {number} of {kernels} …",
        first: "Drawing the first picture …",
        stepOf: "Step {step} of {steps}",
        figures: "{gaussians} Gaussians, loss {loss}",
        heldOut: "PSNR {psnr} dB, of photos that are not used",
        used: "PSNR {psnr} dB, of some of the photos",
        loss: "Loss",
        psnr: "PSNR (dB)",
        pause: "Pause",
        resume: "Resume",
        next: "Next photo",
        download: "Download as PLY",
        noWebgpu: "This browser has no WebGPU, so it cannot train; use a newer Chrome, Edge, Safari or Firefox.",
        memory: "The scene needs more memory than this browser gives; download what there is.",
        failed: "The training has stopped: {reason}",
        keys: "Drag to turn, right button or two fingers to move, wheel or pinch to zoom. W A S D Q E: fly. N: next photo. Space: pause.",
    },
    zh: {
        other: "English",
        scene: "场景",
        training: "训练",
        progress: "已完成步数的比例",
        about: "这些照片此刻正在这台电脑上变成三维场景，不会向任何地方发送数据。",
        reading: "正在读取第 {number} 张照片，共 {photos} 张……",
        preparing: "正在准备第 {number} 个内核，共 {kernels} 个……",
        first: "正在绘制第一幅图像……",
        stepOf: "第 {step} 步，共 {steps} 步",
        figures: "{gaussians} 个高斯，损失 {loss}",
        heldOut: "PSNR {psnr} dB（未参与训练的照片）",
        used: "PSNR {psnr} dB（部分照片）",
        loss: "损失",
        psnr: "PSNR（dB）",
        pause: "暂停",
        resume: "继续",
        next: "下一张照片",
        download: "下载为 PLY",
        noWebgpu: "此浏览器没有 WebGPU，无法训练；请使用较新的 Chrome、Edge、Safari 或 Firefox。",
        memory: "场景需要的内存超过此浏览器所能提供的；可下载现有结果。",
        failed: "训练已停止：{reason}",
        keys: "拖动以旋转，右键或双指以平移，滚轮或双指捏合以缩放。W A S D Q E：飞行。N：下一张照片。空格：暂停。",
    },
};

const wanted = new URLSearchParams(location.search).get("lang") ?? navigator.language;
let language = wanted.toLowerCase().startsWith("zh") ? "zh" : "en";

/** @param {string} name @param {Record<string, string | number>} [values] */
export const say = (name, values = {}) => WORDS[language][name].replace(/\{(\w+)\}/g, (_, key) => String(values[key]));

/** Put the texts into the elements that name them. */
export const translate = () => {
    document.documentElement.lang = language === "zh" ? "zh-CN" : "en";
    for (const element of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-text]")))
        element.textContent = say(element.dataset.text ?? "");
    for (const element of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-label]")))
        element.setAttribute("aria-label", say(element.dataset.label ?? ""));
};

/** The other language. */
export const switchLanguage = () => {
    language = language === "zh" ? "en" : "zh";
    translate();
};
