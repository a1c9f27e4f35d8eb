// The panel of the page. `options` and `settings` are those of the viewer. A view is an array:
// position, target, field of view. The field of view is the angle of the longer side of a rectangle
// of the shape `aspect`. The window shows all of it, whatever its own shape, unless no photo shows
// what is beside it: at a photo, the window then shows a part of the rectangle, which fills it.
const scene = JSON.parse(document.getElementById("sse-bootstrap").textContent).panel;
const { aspect, seen, stops } = scene;
const NARROW = 600;

const UNLIMITED = [Infinity, Infinity];

/**
 * Half of the width and of the height of what the window shows at a distance of 1: the rectangle,
 * but at most so many times its width and its height.
 */
const shownBy = (fov, { width, height }, [widest, highest] = UNLIMITED) => {
    const longer = Math.tan((fov * Math.PI) / 360);
    const [across, down] = [(longer * Math.min(aspect, 1) * height) / width, longer / Math.max(aspect, 1)];
    const half = Math.min(Math.max(down, across), widest * across, highest * down);
    return [(half * width) / height, half];
};

/** The share of what the window would show of a rectangle, if it were not limited. */
const zoomWithin = (fov, size, limits) => shownBy(fov, size, limits)[1] / shownBy(fov, size)[1];

/** How much of the radius of the subject is in the window, above, below and at the sides; at most 1. */
const shownOfSubject = ([x, y, z, u, v, w, fov], size, limits) => {
    const scaled = a => a.map(value => value / Math.hypot(...a));
    const cross = ([a, b, c], [d, e, f]) => [b * f - c * e, c * d - a * f, a * e - b * d];
    const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
    const ahead = scaled([u - x, v - y, w - z]);
    const right = scaled(cross(ahead, [0, 1, 0]));
    const to = [scene.subject[0] - x, scene.subject[1] - y, scene.subject[2] - z];
    const distance = dot(to, ahead);
    if (distance <= 0) return -Infinity;
    const [across, down] = shownBy(fov, size, limits);
    const beside = [
        across * distance - Math.abs(dot(to, right)),
        down * distance - Math.abs(dot(to, cross(right, ahead))),
    ];
    return Math.min(1, Math.min(...beside) / scene.subject[3]);
};

/** The page begins with the first photo, or if it would show little of it, with one that shows the subject. */
const ENOUGH = 0.8;
const firstStop = size => {
    if (!stops.length || zoomWithin(stops[0][6], size, seen[0]) >= ENOUGH) return 0;
    const shown = stops.map((view, i) => shownOfSubject(view, size, seen[i]));
    return shown.findIndex(share => share >= Math.max(...shown) - 0.05);
};
// A start that a person has chosen is that of no photo.
const first = scene.chosen ? -1 : Math.max(0, firstStop({ width: innerWidth, height: innerHeight }));
const start = first > 0 ? stops[first] : scene.start;

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
    const { camera } = app.root.findByName("camera");
    const { canvas } = app.graphicsDevice;
    const [subject, radius] = [scene.subject.slice(0, 3), scene.subject[3]];
    const hiding = hidingSliders(app, subject, scene.hiding);
    // The viewer only logs that the scene cannot be loaded; an unhandled rejection is shown by failure.js.
    app.assets.on("error", error => Promise.reject(error));

    // The viewer sets the field of view before each frame, once the scene is loaded.
    let fov = start[6];
    let fitted = 0;
    let limits = linkedView() ? UNLIMITED : (seen[first] ?? UNLIMITED);
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
        closeControls();
    }).observe(canvas);

    // The list of controls would cover the scene in a window that is, or becomes, narrow; a button opens it.
    let narrow = false;
    const closeControls = () => {
        const before = narrow;
        narrow = state.loaded && canvas.clientWidth < NARROW;
        if (narrow && !before) document.querySelector(".sse-controlsHintClose")?.click();
    };

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

    /** The subject from the present direction, whole and large. */
    const subjectView = () => {
        const { x, y, z } = camera.entity.forward;
        const distance = radius / Math.sin(Math.atan(Math.min(...shownBy(start[6], canvas))));
        const [u, v, w] = subject;
        return [u - distance * x, v - distance * y, w - distance * z, u, v, w, start[6]];
    };

    const begin = () => {
        // In orbit; the viewer itself would begin in its animation.
        viewer.resetCamera();
        hiding.set(linkedHiding() ?? scene.hiding.start);
        closeControls();
        // These follow the viewer's own handlers.
        events.on("inputEvent", name => {
            if (name === "frame") flyTo(subjectView());
            if (name === "reset" && state.cameraMode === "orbit") flyTo(start, seen[first]);
        });
        // The film passes all photos.
        events.on("cameraMode:changed", mode => {
            if (mode === "anim" && seen.length) limits = [0, 1].map(i => Math.min(...seen.map(each => each[i])));
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
        const done = await navigator.clipboard?.writeText(location.href).then(
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
            flyTo(view, seen[i]);
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
    // Keys for the buttons and sliders of the panel are not for the camera.
    panel.addEventListener("keydown", event => {
        if ([" ", "Enter"].includes(event.key) || event.target.type === "range") event.stopPropagation();
    });
    events.on("controlsHidden:changed", hidden =>
        panel.classList.toggle("snow-faded", hidden && strip.hidden && hiding.element.hidden),
    );
    document.querySelector(".sse-viewer").append(panel);
    events.on("loaded:changed", () => document.querySelector(".snow-failure")?.remove());
    // The studio adds its tools.
    window.sse.tools?.({ viewer, scene, camera, canvas, hiding, panel, presentView, flyTo });
});
