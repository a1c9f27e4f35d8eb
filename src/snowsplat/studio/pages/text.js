// All texts of the page, in English and Chinese.

/** @type {Record<string, [string, string]>} */
const TEXTS = {
    name: ["English", "中文"],
    other: ["中文", "English"],
    light: ["Light", "浅色"],
    dark: ["Dark", "深色"],
    auto: ["System colours", "跟随系统"],
    title: ["Photos in, a 3D scene out", "放入照片，得到三维场景"],
    drop: ["Drop photos, a folder, a zip file or a video here", "把照片、文件夹、zip 文件或视频拖到这里"],
    private: ["Everything stays on this computer.", "一切都留在这台电脑上。"],
    choose_files: ["Choose files", "选择文件"],
    choose_folder: ["Choose a folder", "选择文件夹"],
    on_machine: ["Already on the computer where snowsplat runs?", "已经在运行 snowsplat 的电脑上？"],
    path: ["Folder, video or zip file", "文件夹、视频或 zip 文件"],
    browse: ["Browse", "浏览"],
    use: ["Use", "使用"],
    use_this: ["Use this folder ({0} photos and videos)", "使用此文件夹（{0} 个照片和视频）"],
    up: ["Up", "上一级"],
    recent: ["Scenes", "场景"],
    none: ["No scenes yet.", "还没有场景。"],
    kept: ["They are kept in {0}", "保存在 {0}"],
    back: ["All scenes", "所有场景"],
    new: ["Not started", "尚未开始"],
    running: ["Being made", "正在制作"],
    done: ["Finished", "已完成"],
    stopped: ["Stopped", "已停止"],
    failed: ["Failed", "失败"],
    interrupted: ["Interrupted", "已中断"],
    uploading: ["{0} of {1} have arrived", "已上传 {0}，共 {1}"],
    files: ["{0} of {1} files", "{0} / {1} 个文件"],
    left: ["about {0} left", "大约还需 {0}"],
    no_files: ["Drop the photos here, or the same ones again: what has arrived is kept.", "请把照片拖到这里；如果上传中断，请再次拖入同样的照片，已上传的部分会保留。"],
    arrived: ["{0} files have arrived.", "已上传 {0} 个文件。"],
    offline: ["The studio does not answer; trying again …", "工作室没有响应，正在重试……"],
    looking: ["Looking at the photos …", "正在检查照片……"],
    photos: ["Photos", "照片"],
    videos: ["Videos", "视频"],
    sizes: ["Sizes", "尺寸"],
    cameras: ["Cameras", "相机"],
    with_gps: ["With GPS", "带 GPS"],
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
    stop_help: ["What is done is kept; Continue goes on from there. You can close this page, too.", "已完成的部分会保留，可以随时继续。也可以关闭此页面。"],
    was_killed: ["The job ended without a word, as if it was killed or the computer was switched off. Continue goes on from what was saved.", "任务意外结束（可能被终止或电脑关机）。点击“继续”从已保存的部分接着做。"],
    was_stopped: ["Continue goes on from what was saved.", "点击“继续”从已保存的部分接着做。"],
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
    full: ["Open alone", "单独打开"],
    download: ["Download", "下载"],
    preparing: ["Preparing …", "正在准备……"],
    kind_ply: ["For every program", "通用"],
    kind_spz: ["Small, for phones and games", "小巧，适合手机和游戏"],
    kind_sog: ["Small, for the web", "小巧，适合网页"],
    kind_glb: ["glTF, for 3D programs", "glTF，适合三维软件"],
    kind_html: ["One page with a viewer", "带查看器的单个网页"],
    kind_zip: ["A web site, for any host", "网站，可放到任意主机"],
    phone: ["Open it on a phone in the same network", "在同一网络的手机上打开"],
    phone_how: ["To open it on phones, start the studio with: snowsplat studio --host 0.0.0.0", "要在手机上打开，请用此命令启动：snowsplat studio --host 0.0.0.0"],
    command: ["The same in a terminal", "在终端中的相同命令"],
    copy: ["Copy", "复制"],
    viewer: ["The scene", "场景"],
    live: ["The training, live", "实时训练画面"],
};

let column = 0;

/** @param {string} language "en" or "zh" */
export function speak(language) {
    column = language === "zh" ? 1 : 0;
    document.documentElement.lang = language;
}

/**
 * A text in the chosen language; {0}, {1} are replaced.
 * @param {string} key
 * @param {...(string | number)} values
 */
export function say(key, ...values) {
    const text = TEXTS[key]?.[column] ?? key;
    return text.replace(/\{(\d)\}/g, (_, number) => String(values[Number(number)]));
}
