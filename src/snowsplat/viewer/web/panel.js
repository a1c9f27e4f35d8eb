// The panel of the page. `options` and `settings` are those of the viewer. A view is an array:
// position, target, field of view. The field of view is the angle of the longer side of a rectangle
// of the shape `aspect`. The window shows all of it, whatever its own shape, unless no photo shows
// what is beside it: at a photo, the window then shows a part of the rectangle, which fills it.
const scene = JSON.parse(document.getElementById("sse-bootstrap").textContent).panel;
const { aspect, limits: limitsOf = [], stops, start, first = -1 } = scene;

const UNLIMITED = [Infinity, Infinity, 0, 0];

/**
 * Half of the width and of the height of what the window shows at a distance of 1: the rectangle,
 * but at most so many times its width and its height, unless the core of the subject would be cut,
 * which is so wide and high.
 */
const shownBy = (fov, { width, height }, [widest, highest, wide, high] = UNLIMITED) => {
    const longer = Math.tan((fov * Math.PI) / 360);
    const [across, down] = [(longer * Math.min(aspect, 1) * height) / width, longer / Math.max(aspect, 1)];
    const limit = Math.max(Math.min(widest * across, highest * down), high, (wide * height) / width);
    const half = Math.min(Math.max(down, across), limit);
    return [(half * width) / height, half];
};

/** The share of what the window would show of a rectangle, if it were not limited. */
const zoomWithin = (fov, size, limits) => shownBy(fov, size, limits)[1] / shownBy(fov, size)[1];

const addView = ([x, y, z, u, v, w, fov]) => ({ position: [x, y, z], target: [u, v, w], fov });

/** The view in the address of the page; undefined if there is none. */
const linkedView = () => {
    const numbers = /[#&]view=([^&]*)/.exec(location.hash)?.[1].split(",").map(Number);
    const valid =
        numbers?.length === 7 &&
        numbers.every(Number.isFinite) &&
        numbers[6] > 1 &&
        numbers[6] < 170 &&
        Math.hypot(numbers[0] - numbers[3], numbers[1] - numbers[4], numbers[2] - numbers[5]) > 0;
    return valid ? numbers : undefined;
};

/** The values of the sliders in the address of the page; undefined if there are none. */
const linkedHiding = () => {
    const numbers = /[#&]hide=([^&]*)/.exec(location.hash)?.[1].split(",").map(Number);
    return numbers?.length === 2 && numbers.every(x => x >= 0 && x <= 100) ? numbers : undefined;
};

settings.cameras[0].initial = addView(linkedView() ?? start);
createViewer({ container: document.body, settings, ...options }).then(viewer => {
    window.sse.viewer = viewer;
    const { app, state, events, annotations } = viewer;
    // In orbit, at the first view. The viewer itself would begin in its animation.
    events.on("cameraMode:changed", mode => {
        if (mode === "anim" && !state.loaded) state.cameraMode = "orbit";
    });
    const { camera } = app.root.findByName("camera");
    const { canvas } = app.graphicsDevice;
    const [subject, radius] = [scene.subject.slice(0, 3), scene.subject[3]];
    const hiding = hidingSliders(app, subject, scene.hiding);
    // The viewer only logs that the scene cannot be loaded; an unhandled rejection is shown by failure.js.
    app.assets.on("error", error => Promise.reject(error));

    // The viewer sets the field of view before each frame, once the scene is loaded.
    let fov = start[6];
    let fitted = 0;
    let limits = linkedView() ? UNLIMITED : (limitsOf[first] ?? UNLIMITED);
    let zoom = zoomWithin(fov, canvas, limits);
    app.on("update", seconds => {
        if (app.xr.active) return;
        if (camera.fov !== fitted) fov = camera.fov;
        const step = zoomWithin(fov, canvas, limits) - zoom;
        zoom += Math.abs(step) < 1e-3 ? step : step * Math.min(1, 5 * seconds);
        const longest = zoom * Math.max(...shownBy(fov, canvas));
        camera.fov = fitted = (Math.atan(longest) * 360) / Math.PI;
    });
    new ResizeObserver(() => {
        zoom = zoomWithin(fov, canvas, limits);
    }).observe(canvas);

    /** Move to a view, in orbit around its target; for the view of a photo, with its limits. */
    const flyTo = (view, limitsThere = UNLIMITED) => {
        const { position, target, fov } = addView(view);
        // The engine flies to annotations: this one exists only while it is asked for.
        const last = annotations.push({ position: target, camera: { initial: { position, target, fov } } }) - 1;
        viewer.selectAnnotation(last);
        annotations.pop();
        state.selectedAnnotation = null;
        limits = limitsThere;
    };

    const presentView = () => {
        const { x, y, z } = camera.entity.getPosition();
        const ahead = camera.entity.forward;
        const distance = (subject[0] - x) * ahead.x + (subject[1] - y) * ahead.y + (subject[2] - z) * ahead.z;
        const far = Math.max(distance, 0.1 * radius);
        const shown = (Math.atan(zoom * Math.tan((fov * Math.PI) / 360)) * 360) / Math.PI;
        return [x, y, z, x + far * ahead.x, y + far * ahead.y, z + far * ahead.z, shown];
    };

    /** The subject, or so many times its radius, from the present direction, whole and large. */
    const subjectView = (times = 1) => {
        const { x, y, z } = camera.entity.forward;
        const distance = (times * radius) / Math.sin(Math.atan(Math.min(...shownBy(start[6], canvas))));
        const [u, v, w] = subject;
        return [u - distance * x, v - distance * y, w - distance * z, u, v, w, start[6]];
    };

    const begin = () => {
        if (state.cameraMode === "anim") viewer.resetCamera(); // it was ready before this script
        hiding.set(linkedHiding() ?? scene.hiding.start);
        // The list of controls would cover the scene; a button opens it.
        document.querySelector(".sse-controlsHintClose")?.click();
        // These follow the viewer's own handlers.
        events.on("inputEvent", name => {
            if (name === "frame") flyTo(subjectView());
            if (name === "reset" && state.cameraMode === "orbit") flyTo(start, limitsOf[first]);
        });
        // The film passes all photos.
        events.on("cameraMode:changed", mode => {
            if (mode !== "anim" || !stops.length) return;
            limits = [...[0, 1].map(i => Math.min(...limitsOf.map(each => each[i]))), 0, 0];
        });
        window.addEventListener("hashchange", () => {
            const view = linkedView();
            if (view) flyTo(view);
            hiding.set(linkedHiding() ?? scene.hiding.start);
        });
    };
    state.loaded ? begin() : events.once("loaded:changed", begin);

    if (!options.ui) return;
    nameSigns();
    openSwitches();
    Object.assign(canvas, { role: "img", ariaLabel: scene.title });
    const toggle = (label, content) => {
        const button = element("button", {
            type: "button",
            textContent: label,
            ariaExpanded: "false",
        });
        button.onclick = () => {
            content.hidden = !content.hidden;
            button.ariaExpanded = String(!content.hidden);
        };
        content.hidden = true;
        return button;
    };

    const clean = toggle(say("Clean up"), hiding.element);

    const copied = element("span", { className: "snow-copied", role: "status" });
    const link = element("button", {
        type: "button",
        textContent: say("Copy link"),
        title: say("A link to the present view"),
    });
    link.onclick = async () => {
        const view = presentView().map(number => Number(number.toPrecision(6)));
        const values = String(hiding.values());
        const hidden = values === String(scene.hiding.start) ? "" : `&hide=${values}`;
        history.replaceState(null, "", `#view=${view}${hidden}`);
        // In the studio, the address of the page would give away the studio.
        const address = (window.sse.look ?? location.href.split("#")[0]) + location.hash;
        const done = await navigator.clipboard?.writeText(address).then(
            () => true,
            () => false,
        );
        copied.textContent = say(done ? "Copied" : "It is in the address bar");
        setTimeout(() => {
            copied.textContent = "";
        }, 3000);
    };

    const strip = element("div", { className: "snow-stops" });
    const photos = toggle(say("Photos"), strip);
    stops.forEach((view, i) => {
        const stop = element("button", {
            type: "button",
            ariaLabel: `${say("Photo")} ${i + 1} / ${stops.length}`,
        });
        stop.style.backgroundImage = `url("${scene.pictures}")`;
        stop.style.backgroundPositionX = `${stops.length > 1 ? (100 * i) / (stops.length - 1) : 0}%`;
        stop.style.backgroundSize = `${100 * stops.length}% 100%`;
        stop.style.aspectRatio = aspect;
        stop.onclick = () => {
            strip.querySelector("[aria-current]")?.removeAttribute("aria-current");
            stop.ariaCurrent = "true";
            flyTo(view, limitsOf[i]);
        };
        strip.append(stop);
    });

    const panel = element(
        "section",
        { className: "snow-panel", ariaLabel: say("Scene") },
        element(
            "div",
            { className: "snow-card" },
            element("h1", { textContent: scene.title }),
            element(
                "p",
                { textContent: scene.facts.replace("Gaussians", say("Gaussians")) },
                ...(scene.grade
                    ? [element("b", { className: `snow-grade snow-${scene.grade}`, textContent: say(scene.grade) })]
                    : []),
            ),
            element("div", { className: "snow-buttons" }, ...(stops.length ? [photos] : []), clean, link, copied),
        ),
        hiding.element,
        strip,
    );
    events.on("controlsHidden:changed", hidden =>
        panel.classList.toggle("snow-faded", hidden && strip.hidden && hiding.element.hidden),
    );
    const viewerElement = document.querySelector(".sse-viewer");
    viewerElement.role = "main";
    viewerElement.append(panel);
    // Keys for buttons and sliders are not for the camera.
    viewerElement.addEventListener("keydown", event => {
        if ([" ", "Enter"].includes(event.key) || event.target.type === "range") event.stopPropagation();
    });
    // The controls that have been hidden come back before the focus moves, as for the mouse.
    window.addEventListener("keydown", event => event.key === "Tab" && events.fire("inputEvent", "tab"), true);
    events.on("loaded:changed", () => document.querySelector(".snow-failure")?.remove());
    // The studio adds its tools.
    const frame = times => flyTo(subjectView(times));
    window.sse.tools?.({ viewer, scene, camera, canvas, hiding, panel, presentView, flyTo, frame });
});
