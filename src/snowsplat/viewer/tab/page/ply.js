// A scene as a PLY file: 62 properties, as other programs read them.

const REST = 15; // coefficients of each colour after the first
const NAMES = [
    ...["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"],
    ...Array.from({ length: 3 * REST }, (_, k) => `f_rest_${k}`),
    ...["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"],
];

/** @param {number} count @param {import('./density.js').Arrays} values */
export const ply = (count, { means, log_scales, quats, opacity_logits, sh_dc, sh_rest }) => {
    const lines = [
        "ply",
        "format binary_little_endian 1.0",
        `element vertex ${count}`,
        ...NAMES.map(name => `property float ${name}`),
        "end_header\n",
    ];
    const header = new TextEncoder().encode(lines.join("\n"));
    const bytes = new Uint8Array(header.length + 4 * NAMES.length * count);
    bytes.set(header);
    const into = new DataView(bytes.buffer, header.length);
    let at = 0;
    const put = (/** @type {number} */ value) => {
        into.setFloat32(at, value, true);
        at += 4;
    };
    for (let i = 0; i < count; i++) {
        for (let k = 0; k < 3; k++) put(means[3 * i + k]);
        for (let k = 0; k < 3; k++) put(0);
        for (let k = 0; k < 3; k++) put(sh_dc[3 * i + k]);
        for (let c = 0; c < 3; c++) for (let k = 0; k < REST; k++) put(sh_rest[3 * (REST * i + k) + c]);
        put(opacity_logits[i]);
        for (let k = 0; k < 3; k++) put(log_scales[3 * i + k]);
        for (let k = 0; k < 4; k++) put(quats[4 * i + k]);
    }
    return bytes;
};
