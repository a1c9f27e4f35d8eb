// The texts of the page in English and Chinese. The address may say "?lang=zh", as for the viewer.
const CHINESE = {
    Crop: "裁剪",
    "Hide floaters": "隐藏漂浮物",
    "Clean up": "清理",
    "Copy link": "复制链接",
    "A link to the present view": "当前视角的链接",
    Copied: "已复制",
    "It is in the address bar": "链接在地址栏中",
    Photos: "照片",
    Photo: "照片",
    Scene: "场景",
    Gaussians: "个高斯",
    good: "好",
    usable: "可用",
    poor: "差",
    "Play the film": "播放影片",
    "Pause the film": "暂停影片",
    Orbit: "环绕",
    Fly: "飞行",
    Walk: "行走",
    Settings: "设置",
    Controls: "操作说明",
    About: "信息",
    "Augmented reality": "增强现实",
    "Virtual reality": "虚拟现实",
    "Full screen": "全屏",
    "Leave full screen": "退出全屏",
    "Previous annotation": "上一个标注",
    "Next annotation": "下一个标注",
    Close: "关闭",
};
const language = new URLSearchParams(location.search).get("lang") ?? navigator.language;
const say = english => (language.toLowerCase().startsWith("zh") ? (CHINESE[english] ?? english) : english);

// Buttons of the viewer that have only a sign, and what a screen reader says. Its own texts appear
// when the mouse is on them.
const SIGNS = {
    play: "Play the film",
    pause: "Pause the film",
    orbitCamera: "Orbit",
    flyCamera: "Fly",
    fpsCamera: "Walk",
    settings: "Settings",
    controlsButton: "Controls",
    info: "About",
    arMode: "Augmented reality",
    vrMode: "Virtual reality",
    enterFullscreen: "Full screen",
    exitFullscreen: "Leave full screen",
    annotationPrev: "Previous annotation",
    annotationNext: "Next annotation",
    controlsHintClose: "Close",
    infoClose: "Close",
};
const nameSigns = () => {
    for (const [name, label] of Object.entries(SIGNS)) {
        const button = document.querySelector(`button.sse-${name}`);
        if (button) button.ariaLabel = say(label);
    }
    for (const sign of document.querySelectorAll(".sse-viewer svg")) sign.setAttribute("aria-hidden", "true");
};

/** The switches of the viewer's settings are for the mouse only; here they get the keyboard, too. */
const openSwitches = () => {
    for (const each of document.querySelectorAll(".sse-toggleSwitch")) {
        const label = each.previousElementSibling.textContent;
        Object.assign(each, { role: "switch", tabIndex: 0, ariaLabel: label });
        const tell = () => {
            each.ariaChecked = String(each.classList.contains("sse-active"));
        };
        new MutationObserver(tell).observe(each, { attributeFilter: ["class"] });
        tell();
        each.addEventListener("keydown", event => {
            if (![" ", "Enter"].includes(event.key)) return;
            event.preventDefault(); // the space bar would scroll
            each.click();
        });
    }
};
