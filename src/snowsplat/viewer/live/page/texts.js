// The texts of the page in its two languages. {name} is replaced by a value.

/** @type {Record<string, Record<string, string>>} */
export const TEXTS = {
    en: {
        scene: "Scene",
        controls: "Controls",
        theme: "Light or dark",
        hide: "Hide the controls",
        other: "中文",
        connecting: "Connecting …",
        lost: "The connection is lost; if snowsplat has ended or was started again, open the URL that it prints then.",
        waitingForScene: "Waiting for the first image …",
        training: "Training",
        progress: "Finished share of the steps",
        waiting: "Waiting for the first step",
        stepOf: "Step {step} of {steps}, {pace}",
        stepsPerSecond: "{rate} steps/s",
        paused: "paused",
        figures: "{gaussians} Gaussians, loss {loss}",
        figuresPsnr: "{gaussians} Gaussians, loss {loss}, PSNR {psnr} dB",
        pause: "Pause",
        resume: "Resume",
        step: "One step",
        viewing: "Viewing time (%)",
        viewingHint: "While a camera moves: the share of the time for its images",
        loss: "Loss",
        psnr: "PSNR (dB)",
        about: "Scene",
        display: "Display",
        show: "Show",
        color: "Colour",
        depth: "Depth",
        alpha: "Opacity",
        normals: "Normals",
        points: "Points",
        ellipsoids: "Ellipsoids",
        cost: "Gaussians per pixel",
        error: "Error against the photo",
        colorLegend: "",
        depthLegend: "Yellow is near, violet is far.",
        alphaLegend: "White is opaque, black is empty.",
        normalsLegend: "Red: right, green: up, blue: towards you; the shortest axis of each Gaussian.",
        pointsLegend: "The centre of each Gaussian.",
        ellipsoidsLegend: "Each Gaussian as a solid body of 1.5 standard deviations.",
        costLegend: "Gaussians that are blended per pixel.",
        errorLegend: "The difference of the colours, as a share of their range.",
        needsPhoto: "Only at the position of a photo: click a camera, or Next below.",
        far: "far",
        near: "near",
        degree: "SH degree",
        degreeHint: "Degree of the view-dependent colour",
        size: "Gaussian size (%)",
        sizeHint: "Small values separate the Gaussians",
        longest: "Image size",
        longestHint: "Longer side in pixels while the camera does not move",
        photos: "Photos",
        cameras: "Show the cameras",
        nowhere: "Click a camera to view the scene from its position.",
        at: "At {name}",
        heldOut: "At {name}, which is not used for training",
        previous: "Previous",
        next: "Next",
        wipe: "Photo (%)",
        wipeHint: "How much of the rendering the photo covers, from the left",
        render: "Render",
        photo: "Photo",
        crop: "Crop box",
        cropped: "Show only what is in the box",
        axis0: "x (right)",
        axis1: "y (down)",
        axis2: "z (forward)",
        from: "{axis}, from",
        to: "{axis}, to",
        video: "Video",
        none: "Store two or more views to make a video.",
        stored: "{count} stored. Use the file with: snowsplat render OUT --path cameras.json",
        store: "Store this view",
        remove: "Remove the last view",
        download: "Download the views",
        help: "Mouse and keys",
        mouse: "Drag to rotate, right button or two fingers to move, wheel or pinch to zoom.",
        keys: "W A S D Q E: fly. Arrows: rotate. F: the whole scene. R: the first view. N, P: next and previous photo. L: light or dark. Space: pause.",
    },
    zh: {
        scene: "场景",
        controls: "控制面板",
        theme: "浅色或深色",
        hide: "隐藏控制面板",
        other: "English",
        connecting: "正在连接……",
        lost: "连接已断开；如果 snowsplat 已结束或已重新启动，请打开它重新启动后显示的网址。",
        waitingForScene: "正在等待第一幅图像……",
        training: "训练",
        progress: "已完成的步数比例",
        waiting: "正在等待第一步",
        stepOf: "第 {step} 步，共 {steps} 步，{pace}",
        stepsPerSecond: "每秒 {rate} 步",
        paused: "已暂停",
        figures: "{gaussians} 个高斯，损失 {loss}",
        figuresPsnr: "{gaussians} 个高斯，损失 {loss}，PSNR {psnr} dB",
        pause: "暂停",
        resume: "继续",
        step: "单步",
        viewing: "观看时间（%）",
        viewingHint: "相机移动时，用于渲染其图像的时间比例",
        loss: "损失",
        psnr: "PSNR（dB）",
        about: "场景",
        display: "显示",
        show: "内容",
        color: "颜色",
        depth: "深度",
        alpha: "不透明度",
        normals: "法线",
        points: "点",
        ellipsoids: "椭球",
        cost: "每像素的高斯数",
        error: "与照片的误差",
        colorLegend: "",
        depthLegend: "黄色近，紫色远。",
        alphaLegend: "白色不透明，黑色为空。",
        normalsLegend: "红：向右，绿：向上，蓝：朝向观察者；每个高斯的最短轴。",
        pointsLegend: "每个高斯的中心。",
        ellipsoidsLegend: "每个高斯显示为 1.5 倍标准差的实体。",
        costLegend: "每个像素混合的高斯数。",
        errorLegend: "颜色之差占其取值范围的比例。",
        needsPhoto: "仅在照片的位置可用：点击一台相机，或点击下方的“下一张”。",
        far: "远",
        near: "近",
        degree: "SH 阶数",
        degreeHint: "随视角变化的颜色的阶数",
        size: "高斯大小（%）",
        sizeHint: "较小的值使各个高斯分开",
        longest: "图像尺寸",
        longestHint: "相机不动时，较长边的像素数",
        photos: "照片",
        cameras: "显示相机",
        nowhere: "点击一台相机，从它的位置观看场景。",
        at: "位于 {name}",
        heldOut: "位于 {name}（未用于训练）",
        previous: "上一张",
        next: "下一张",
        wipe: "照片（%）",
        wipeHint: "照片从左侧覆盖渲染图的比例",
        render: "渲染图",
        photo: "照片",
        crop: "裁剪框",
        cropped: "只显示框内的部分",
        axis0: "x（右）",
        axis1: "y（下）",
        axis2: "z（前）",
        from: "{axis}，从",
        to: "{axis}，到",
        video: "视频",
        none: "保存两个或更多视角以制作视频。",
        stored: "已保存 {count} 个。使用该文件：snowsplat render OUT --path cameras.json",
        store: "保存当前视角",
        remove: "删除最后一个视角",
        download: "下载这些视角",
        help: "鼠标与按键",
        mouse: "拖动以旋转，右键或双指以平移，滚轮或双指捏合以缩放。",
        keys: "W A S D Q E：飞行。方向键：旋转。F：整个场景。R：初始视角。N、P：下一张和上一张照片。L：浅色或深色。空格：暂停。",
    },
};

// The page of the studio says its language in the address.
const wanted = new URLSearchParams(location.search).get("lang") ?? navigator.language;
let language = wanted.toLowerCase().startsWith("zh") ? "zh" : "en";

/** The text of this name. @param {string} name @param {Record<string, string | number>} [values] */
export const text = (name, values = {}) => TEXTS[language][name].replace(/\{(\w+)\}/g, (_, key) => String(values[key]));

/** A text of the server, which has it in each language. @param {Record<string, string>} told */
export const inLanguage = told => told[language];

/** A number with the separators of English, which Chinese uses, too. @param {number} value @param {number} [digits] */
export const number = (value, digits = 0) =>
    value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });

/** Put the texts into the elements that name them. */
export const translate = () => {
    document.documentElement.lang = language === "zh" ? "zh-CN" : "en";
    for (const element of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-text]")))
        element.textContent = text(element.dataset.text ?? "");
    for (const element of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-label]"))) {
        element.setAttribute("aria-label", text(element.dataset.label ?? ""));
        if (element instanceof HTMLButtonElement) element.title = text(element.dataset.label ?? "");
    }
    for (const element of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-hint]")))
        element.title = text(element.dataset.hint ?? "");
};

/** The other language. */
export const switchLanguage = () => {
    language = language === "zh" ? "en" : "zh";
    translate();
};
