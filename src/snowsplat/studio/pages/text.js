// All texts of the page, in English and Chinese.

/** @type {Record<string, [string, string]>} */
const TEXTS = {
    name: ["English", "中文"],
    other: ["中文", "English"],
    light: ["Light", "浅色"],
    dark: ["Dark", "深色"],
    auto: ["System", "系统"],
    colours: ["Colours: {0}", "颜色：{0}"],
    title: ["Photos in, a 3D scene out", "放入照片，得到三维场景"],
    drop: [
        "Drop photos, a folder, a zip file or a video here; or a finished scene: .ply, .spz, .sog, .glb",
        "把照片、文件夹、zip 文件或视频拖到这里；也可以是已完成的场景：.ply、.spz、.sog、.glb",
    ],
    give: [
        "Photos, a zip file or a video; or a finished scene: .ply, .spz, .sog, .glb",
        "照片、zip 文件或视频；也可以是已完成的场景：.ply、.spz、.sog、.glb",
    ],
    advice: [
        "30 to 100 sharp photos of one object or place from all sides, or a slow video. Each photo shows most of what the one before shows.",
        "围绕一个物体或地方，从各个方向拍 30 到 100 张清晰的照片，或一段缓慢移动的视频。每张照片都应包含前一张的大部分内容。",
    ],
    private: ["Everything stays on this computer.", "一切都留在这台电脑上。"],
    choose_files: ["Choose files", "选择文件"],
    choose_folder: ["Choose a folder", "选择文件夹"],
    try_example: ["Try an example", "试试示例"],
    example: ["Example: a still life", "示例：静物"],
    on_machine: ["Already on the computer where snowsplat runs?", "已经在运行 snowsplat 的电脑上？"],
    path: ["Folder, video or zip file", "文件夹、视频或 zip 文件"],
    browse: ["Browse", "浏览"],
    use: ["Use", "使用"],
    use_this: ["Use this folder (files: {0})", "使用此文件夹（{0} 个文件）"],
    up: ["Up", "上一级"],
    recent: ["Scenes", "场景"],
    none: ["No scenes yet.", "还没有场景。"],
    kept: ["They are kept in {0}", "保存在 {0}"],
    back: ["All scenes", "所有场景"],
    new: ["Not started", "尚未开始"],
    running: ["Being made", "正在制作"],
    done: ["Finished", "已完成"],
    grade_good: ["good", "好"],
    grade_usable: ["usable, with limits", "可用，但有局限"],
    grade_poor: ["poor", "差"],
    found: ["Made in a terminal", "由命令行制作"],
    opening: ["Preparing the viewer …", "正在准备查看器……"],
    kept_at: ["It is kept in {0}", "保存在 {0}"],
    rename: ["Rename", "重命名"],
    remove: ["Remove this scene", "删除此场景"],
    remove_help: [
        "The scene, its downloads and its site are removed. Photos are kept.",
        "场景、下载文件和网站会被删除。照片会保留。",
    ],
    remove_sure: [
        "Remove the scene {0}? This cannot be undone. Photos are kept.",
        "删除场景“{0}”？此操作无法撤销。照片会保留。",
    ],
    removed: ["The scene is removed.", "场景已删除。"],
    removed_but: ["The scene is removed. Its photos are still in {0}", "场景已删除。照片仍在 {0}"],
    stopped: ["Stopped", "已停止"],
    failed: ["Failed", "失败"],
    interrupted: ["Interrupted", "已中断"],
    uploading: ["{0} of {1} have arrived", "已上传 {0}，共 {1}"],
    files: ["{0} of {1} files", "{0} / {1} 个文件"],
    left: ["about {0} left", "大约还需 {0}"],
    not_arrived: [
        "Files that have not arrived completely: {0}. They are not used; drop them again.",
        "有 {0} 个文件没有传完，不会被使用：请再次拖入这些文件。",
    ],
    no_files: [
        "Drop the photos here, or the same ones again: what has arrived is kept.",
        "请把照片拖到这里；如果上传中断，请再次拖入同样的照片，已上传的部分会保留。",
    ],
    offline: [
        "The studio does not answer; if it has ended or was started again, run: snowsplat studio, and use the page that it opens.",
        "工作室没有响应；如果它已结束或已重新启动，请运行 snowsplat studio，并使用它打开的页面。",
    ],
    no_photos: [
        "These files are no photos, no video and no scene; drop photos.",
        "这些文件不是照片、视频或场景；请拖入照片。",
    ],
    checking: ["Checking whether photos are blurred, damaged or doubles …", "正在检查照片是否模糊、损坏或重复……"],
    marked: ["{0} of {1} photos are marked.", "{1} 张照片中有 {0} 张带有标记。"],
    unmarked: ["No photo is blurred, damaged or a double.", "没有模糊、损坏或重复的照片。"],
    click_photo: ["Click a photo to leave it out.", "点击照片即可不使用它。"],
    leave_out: ["Leave out {0}", "不使用 {0}"],
    looking: ["Looking at the photos …", "正在检查照片……"],
    photos: ["Photos", "照片"],
    videos: ["Videos", "视频"],
    sizes: ["Sizes", "尺寸"],
    cameras: ["Cameras", "相机"],
    with_gps: ["With GPS", "带 GPS"],
    poses: ["Camera poses", "相机位姿"],
    given: ["those of the folder are used", "使用文件夹中已有的位姿"],
    not_used: ["Not used", "未使用"],
    doubtful: ["Doubtful", "存疑"],
    quality: ["How long may it take?", "可以用多长时间？"],
    draft: ["Draft", "草稿"],
    normal: ["Normal", "标准"],
    best: ["Best", "最佳"],
    within: ["Within", "限时"],
    title_label: ["Name", "名称"],
    add_files: ["Add files", "添加文件"],
    minutes_label: ["minutes", "分钟"],
    about_time: ["about {0}", "大约 {0}"],
    start: ["Make the scene", "制作场景"],
    again: ["Make it again", "重新制作"],
    resume: ["Continue", "继续"],
    stop: ["Stop", "停止"],
    stop_help: [
        "What is done is kept; Continue goes on from there. You can close this page, too.",
        "已完成的部分会保留，可以随时继续。也可以关闭此页面。",
    ],
    was_killed: [
        "The job ended without a word, as if it was killed or the computer was switched off. Continue goes on from what was saved.",
        "任务意外结束（可能被终止或电脑关机）。点击“继续”从已保存的部分接着做。",
    ],
    was_stopped: ["Continue goes on from what was saved.", "点击“继续”从已保存的部分接着做。"],
    more: ["More", "更多"],
    stage_demo: ["Taking photos of a synthetic scene", "拍摄合成场景的照片"],
    stage_photos: ["Reading the photos", "读取照片"],
    stage_poses: ["Finding the cameras", "估计相机位置"],
    stage_images: ["Removing lens distortion", "去除镜头畸变"],
    stage_report: ["Report on the cameras", "相机报告"],
    stage_scene: ["Training", "训练"],
    stage_pictures: ["Rendering test views", "渲染测试视图"],
    stage_all: ["Training with all photos", "用全部照片训练"],
    stage_page: ["Preparing the viewer", "准备查看器"],
    before: ["done earlier", "之前已完成"],
    step: ["Step", "步"],
    of: ["{0} of {1}", "{0} / {1}"],
    gaussians: ["Gaussians", "高斯数"],
    psnr: ["PSNR of held-out photos", "留出照片的 PSNR"],
    psnr_aligned: ["PSNR of held-out photos, colours aligned", "留出照片的 PSNR（颜色对齐）"],
    loss: ["Loss", "损失"],
    placed: ["Photos", "照片"],
    map: ["Cameras and points, from above", "相机与点云（俯视）"],
    seconds: ["{0} s", "{0} 秒"],
    minutes: ["{0} min", "{0} 分钟"],
    hours: ["{0} h", "{0} 小时"],
    log: ["Notes", "说明"],
    took: ["Time", "用时"],
    size: ["Size", "大小"],
    verdict: ["Verdict", "评价"],
    report_training: ["Report on the training", "训练报告"],
    report_photos: ["Report on the cameras", "相机报告"],
    full: ["Open in a new tab", "在新标签页中打开"],
    download: ["Download", "下载"],
    download_kind: ["Download {0}", "下载 {0}"],
    preparing: ["Preparing …", "正在准备……"],
    kind_ply: ["For every program", "通用"],
    kind_spz: ["Small, for phones and games", "小巧，适合手机和游戏"],
    kind_sog: ["Small, for the web", "小巧，适合网页"],
    kind_glb: ["Gaussians in glTF, for 3D programs", "glTF 中的高斯，适合三维软件"],
    kind_usdz: ["Gaussians in OpenUSD", "OpenUSD 中的高斯"],
    kind_mesh: [
        "Surfaces as triangles (glTF), for Blender and games; without edits",
        "三角形表面（glTF），适合 Blender 和游戏；不含编辑",
    ],
    kind_points: ["A dense cloud of points (PLY); without edits", "稠密点云（PLY）；不含编辑"],
    kind_ar: [
        "Surfaces for augmented reality (USDZ) on an iPhone or iPad; without edits",
        "用于 iPhone 和 iPad 增强现实的表面（USDZ）；不含编辑",
    ],
    kind_html: ["One page with a viewer", "带查看器的单个网页"],
    kind_zip: ["A web site; unpack it on any web host", "网站，解压到任意网站主机即可"],
    embed: ["Show it in a web page", "嵌入网页"],
    embed_how: [
        "Unpack the ZIP on a web host, put its address into this line, and the line into a page:",
        "将 ZIP 解压到网站主机，把其地址填入此行，再将此行放进网页：",
    ],
    look: [
        "These links only show the scene, as long as the studio runs. On this computer:",
        "这些链接只能查看场景，在工作室运行期间有效。在本机上：",
    ],
    phone: ["Open it on a phone in the same network", "在同一网络的手机上打开"],
    phone_how: [
        "To open it on phones, start the studio with: snowsplat studio --host 0.0.0.0",
        "要在手机上打开，请用此命令启动：snowsplat studio --host 0.0.0.0",
    ],
    command: ["The same in a terminal", "在终端中的相同命令"],
    copy: ["Copy", "复制"],
    copied: ["Copied", "已复制"],
    viewer: ["The scene", "场景"],
    live: ["The training, live", "实时训练画面"],
    film: ["Film", "影片"],
    film_empty: [
        "Move the camera, and add two or more views. The film passes them in their order.",
        "移动相机并添加两个或更多视角，影片会依次经过这些视角。",
    ],
    film_add: ["Add this view", "添加此视角"],
    film_replace: ["Replace", "替换"],
    film_remove: ["Remove", "移除"],
    film_turn: ["360° turn", "环绕 360°"],
    film_key: ["View {0}", "视角 {0}"],
    film_speed: ["speed", "速度"],
    film_line: ["Time line", "时间线"],
    film_seconds: ["Seconds", "秒数"],
    film_size: ["Format", "画幅"],
    film_1920x1080: ["Wide, 1920 × 1080", "横屏 1920 × 1080"],
    film_1080x1920: ["Portrait, 1080 × 1920", "竖屏 1080 × 1920"],
    film_1080x1080: ["Square, 1080 × 1080", "方形 1080 × 1080"],
    film_ease: ["Begin and end slowly", "缓入缓出"],
    film_loop: ["Back to the first view", "回到第一个视角"],
    film_preview: ["Preview", "预览"],
    film_pause: ["Pause", "暂停"],
    film_render: ["Make the film", "制作影片"],
    film_rendering: ["Rendering", "正在渲染"],
    film_stopped: ["Stopped; there is no new film", "已停止，没有新的影片"],
    film_download: ["Download the film (MP4, {0})", "下载影片（MP4，{0}）"],
    edit: ["Edit", "编辑"],
    edit_whole: [
        "Preparing all Gaussians for editing. Use a computer with enough graphics memory, not a phone …",
        "正在准备全部高斯以供编辑。请使用显存充足的电脑，而不是手机……",
    ],
    edit_rectangle: ["Rectangle", "矩形"],
    edit_lasso: ["Lasso", "套索"],
    edit_brush: ["Brush", "画笔"],
    edit_box: ["Box", "裁剪框"],
    edit_measure: ["Measure", "测量"],
    edit_note: ["Annotate", "标注"],
    edit_level: ["Level and turn", "调平与旋转"],
    edit_level_how: [
        "Click three points of the floor to level the scene, or turn it about an axis; y is up.",
        "点击地面上的三个点即可调平场景，或绕某个轴旋转；y 轴朝上。",
    ],
    edit_level_points: ["{0} of 3 points", "已点击 {0} / 3 个点"],
    edit_on_a_line: ["The three points are on a line; click others", "三个点在一条直线上；请点击其他位置"],
    edit_turn: ["Turn about {0} by {1}°", "绕 {0} 轴旋转 {1}°"],
    edit_turn_fine: ["Turn about {0}, finely", "绕 {0} 轴微调"],
    edit_note_how: [
        "Click a place of the scene to annotate it; the present view is that of the annotation.",
        "点击场景中的位置添加标注；当前视角即为标注的视角。",
    ],
    edit_note_new: ["Annotation {0}", "标注 {0}"],
    edit_note_title: ["Title", "标题"],
    edit_note_text: ["Text", "文字"],
    edit_note_untitled: ["An annotation has no title", "有标注没有标题"],
    edit_hides: ["Also remove what the sliders of Clean up hide", "同时删除“清理”滑块所隐藏的部分"],
    edit_select: ["Select", "选择"],
    edit_scene: ["Scene", "场景"],
    edit_help: ["Help", "帮助"],
    edit_keys: [
        "Shift adds to the selection, Alt subtracts from it, Esc leaves a tool; then the mouse moves the camera. Without a mouse, the arrow keys move a cross, and Enter presses and releases it.",
        "按住 Shift 加选，按住 Alt 减选；按 Esc 退出工具，之后鼠标移动相机。没有鼠标时，方向键移动十字光标，Enter 键按下和松开。",
    ],
    edit_cross: [
        "Cross: the arrow keys move it, Enter presses and releases it",
        "十字光标：方向键移动，Enter 键按下和松开",
    ],
    edit_units: ["{0} units", "{0} 单位"],
    edit_mode: ["The next selection", "下一次选择"],
    edit_replace: ["Replaces", "替换"],
    edit_add: ["Adds", "加选"],
    edit_remove: ["Subtracts", "减选"],
    edit_invert: ["Invert", "反选"],
    edit_delete: ["Delete", "删除"],
    edit_undo: ["Undo", "撤销"],
    edit_redo: ["Redo", "重做"],
    edit_first: [
        "Choose a tool to select something, then delete it. Nothing is changed before Save, and the original is kept.",
        "选择一个工具选中要去掉的部分，再删除。保存之前不会有任何改动，原场景也会保留。",
    ],
    edit_counts: ["{0} Gaussians selected, {1} deleted", "已选 {0} 个高斯，已删 {1} 个"],
    edit_radius: ["Radius", "半径"],
    edit_from: ["{0} from", "{0} 从"],
    edit_to: ["{0} to", "{0} 到"],
    edit_box_how: [
        "Drag the faces of the box, or focus one and use the arrow keys.",
        "拖动裁剪框的面，或选中一个面后使用方向键。",
    ],
    edit_outside: ["Select what is outside", "选择框外部分"],
    edit_two_points: ["Click two points of the scene", "点击场景中的两个点"],
    edit_no_surface: ["There is no surface; click another place", "这里没有表面；请点击别处"],
    edit_distance: ["Distance: {0}", "距离：{0}"],
    edit_truth: ["True length (m)", "真实长度（米）"],
    edit_rescale: ["Set scale", "设定比例"],
    edit_size: ["Size × {0}: one unit is one metre", "尺寸 × {0}：一个单位为一米"],
    edit_start: ["Start with this view", "以此视角开始"],
    edit_start_set: ["The scene will start with this view", "场景将以此视角开始"],
    edit_notes_most: ["A scene has at most {0} annotations", "一个场景最多有 {0} 个标注"],
    edit_save: ["Save", "保存"],
    edit_saving: ["Saving…", "正在保存…"],
    edit_back: ["Back to the original", "恢复原场景"],
    edit_back_sure: ["Remove all edits of this scene?", "删除此场景的所有编辑？"],
    edited: ["edited", "已编辑"],
};

let column = 0;

/** The language that was chosen in the browser. */
export const chosenLanguage = () =>
    localStorage.getItem("language") ?? (navigator.language.startsWith("zh") ? "zh" : "en");

/** The colours that were chosen in the browser: "light", "dark" or "auto". */
export const chosenTheme = () => localStorage.getItem("theme") ?? "auto";

/** An address of another page of the studio, which appears in the language and the colours of this one. */
export const dressed = (/** @type {string} */ address) => `${address}?lang=${chosenLanguage()}&theme=${chosenTheme()}`;

/** @param {string} language "en" or "zh" */
export function speak(language) {
    column = language === "zh" ? 1 : 0;
    document.documentElement.lang = language;
}

/**
 * A text of the program in the chosen language.
 * @param {import("./types.js").Told | number | boolean} text
 * @returns {string}
 */
export const told = text => {
    if (typeof text !== "object") return String(text);
    return column ? text.zh : text.en;
};

/**
 * A text in the chosen language; {0}, {1} are replaced.
 * @param {string} key
 * @param {...(string | number)} values
 */
export function say(key, ...values) {
    const text = TEXTS[key]?.[column] ?? key;
    return text.replace(/\{(\d)\}/g, (_, number) => String(values[Number(number)]));
}
