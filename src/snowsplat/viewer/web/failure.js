// Says on the page, in English and Chinese, why it shows no scene, and what to do. It is a classic script at
// the beginning of the page, in the JavaScript of 2016, so that it also works where the others do not.
{
    const OLD = [
        "This browser is too old to draw the scene. Use a newer browser.",
        "此浏览器版本过旧，无法显示场景。请使用更新的浏览器。",
    ];
    const FROM_DISK = [
        "Browsers do not load this page from disk: put its whole folder on a web host, or run snowsplat view with the folder.",
        "浏览器无法从磁盘加载此网页：请把整个文件夹放到网站服务器上，或对该文件夹运行 snowsplat view。",
    ];
    const NO_WEBGL = [
        "This browser has no WebGL 2, so it cannot draw the scene. Use another browser, or switch on hardware acceleration.",
        "此浏览器没有 WebGL 2，无法显示场景。请使用其他浏览器，或打开硬件加速。",
    ];
    const INCOMPLETE = [
        "A file of this page cannot be loaded: check that its whole folder is on the web host, and load the page again.",
        "无法加载此网页的一个文件：请确认整个文件夹都在网站服务器上，然后重新加载网页。",
    ];

    /** The lines to show; `script`: the failure is that a script of the page could not be loaded. */
    const reason = (error, script) => {
        // A page without this link contains all its files.
        const separate = document.querySelector('link[rel="stylesheet"]');
        if (separate && location.protocol === "file:") return FROM_DISK;
        if (!document.createElement("canvas").getContext("webgl2")) return NO_WEBGL;
        const message = String((error && error.message) || error);
        // Each browser has its own words for a failed request; the viewer has those for other answers than 200.
        return script || /fetch|network|load failed|loading resource/i.test(message) ? INCOMPLETE : [message];
    };

    const show = lines => {
        let place = document.querySelector(".snow-failure");
        if (!place) {
            place = document.createElement("div");
            place.className = "snow-failure";
            place.setAttribute("role", "alert");
            document.body.appendChild(place);
        }
        place.textContent = lines.join("\n");
    };

    const explain = (error, script) => {
        const viewer = window.sse && window.sse.viewer;
        if (!viewer || !viewer.state.loaded) show(reason(error, script));
    };

    // The viewer does not handle all its failures. It would show its empty loading bar forever.
    addEventListener("unhandledrejection", event => explain(event.reason));
    const capture = true; // the error of an element does not bubble
    addEventListener(
        "error",
        event => {
            if (event.target.tagName === "SCRIPT") explain(undefined, true);
            else if (event.error instanceof SyntaxError) show(OLD);
        },
        capture,
    );
    addEventListener("DOMContentLoaded", () => {
        if (!("noModule" in document.createElement("script"))) show(OLD);
    });
}
