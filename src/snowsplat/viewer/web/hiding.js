// Sliders that hide Gaussians: those far from the subject (crop), and large ones, which float around
// a scene or in front of it. The engine copies all Gaussians into a buffer before it draws them, and
// lets this code change the copies. A Gaussian of size 0 is not drawn.
const HIDING = {
    glsl: `
uniform vec4 snowKept;
uniform float snowLargest;
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 center, vec3 modified, inout vec4 rotation, inout vec3 scale) {
    float size = max(scale.x, max(scale.y, scale.z));
    if (distance(center, snowKept.xyz) > snowKept.w || size > snowLargest) scale = vec3(0.0);
}
void modifySplatColor(vec3 center, inout vec4 color) {}`,
    wgsl: `
uniform snowKept: vec4f;
uniform snowLargest: f32;
fn modifySplatCenter(center: ptr<function, vec3f>) {}
fn modifySplatRotationScale(center: vec3f, modified: vec3f, rotation: ptr<function, vec4f>, scale: ptr<function, vec3f>) {
    let size = max((*scale).x, max((*scale).y, (*scale).z));
    if (distance(center, uniform.snowKept.xyz) > uniform.snowKept.w || size > uniform.snowLargest) {
        *scale = vec3f(0.0);
    }
}
fn modifySplatColor(center: vec3f, color: ptr<function, vec4f>) {}`,
};
const EVERYTHING = 1e30;

const element = (name, properties, ...children) => {
    const made = Object.assign(document.createElement(name), properties);
    made.append(...children);
    return made;
};

/**
 * Two sliders; distances are from [x, y, z]. `limits`: see hiding.py. A slider at 0 hides nothing; from
 * there, its limit shrinks in equal ratios. The engine gets the code when it is needed first.
 */
const hidingSliders = (app, [x, y, z], limits) => {
    let gsplat;
    const use = code => {
        ({ gsplat } = app.root.findByName("gsplat"));
        gsplat.setWorkBufferModifier(code);
    };
    /** The largest distance and the largest size that are shown. */
    const shown = () =>
        sliders.map(({ value }, i) => {
            const [all, least] = limits[["distance", "size"][i]];
            return value > 0 ? all * (least / all) ** (value / 100) : EVERYTHING;
        });
    const apply = () => {
        const [distance, size] = shown();
        if (!gsplat) {
            if (Math.min(distance, size) === EVERYTHING) return;
            use(HIDING);
        }
        gsplat.setParameter("snowKept", [x, y, z, distance]);
        gsplat.setParameter("snowLargest", size);
        app.renderNextFrame = true;
    };
    const sliders = limits.start.map(value =>
        element("input", { type: "range", min: 0, max: 100, value, oninput: apply }),
    );
    return {
        element: element(
            "div",
            { className: "snow-hiding snow-card" },
            element("label", {}, say("Crop"), sliders[0]),
            element("label", {}, say("Hide floaters"), sliders[1]),
        ),
        code: HIDING,
        /** Gives the engine code that contains this one. */
        use: code => {
            use(code);
            apply();
        },
        /** Everything that is hidden: from [x, y, z], beyond a distance, or larger than a size; null if nothing is. */
        limits: () => (sliders.some(({ value }) => value > 0) ? [x, y, z, ...shown()] : null),
        values: () => sliders.map(({ value }) => Number(value)),
        set: values => {
            values.forEach((value, i) => {
                sliders[i].value = value;
            });
            apply();
        },
    };
};
