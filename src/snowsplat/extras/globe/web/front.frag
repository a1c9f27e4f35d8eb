// Puts the glass and the base in front of the Gaussians.
uniform sampler2D inside;
uniform sampler2D plate;
out vec4 color;

float hypot2(vec2 v) {
    return length(max(v, 0.0));
}

// The light from a direction in the frame of the camera.
vec3 environment(vec3 d) {
    vec3 light = mix(vec3(0.10, 0.11, 0.13), vec3(0.70, 0.74, 0.80), smooth_(0.5, -0.9, d.y));
    if (d.z < -0.05) {
        vec2 pane = abs((d.xy / -d.z + 0.95) / vec2(0.42, 0.52));
        light += 9.0 * smooth_(1.0, 0.93, pane.x) * smooth_(1.0, 0.93, pane.y)
            * smooth_(0.03, 0.08, pane.x) * smooth_(0.03, 0.08, pane.y);
    }
    float soft = smooth_(0.82, 1.0, dot(d, vec3(0.80, -0.35, -0.49)));
    return light + 1.6 * soft * vec3(1.0, 0.97, 0.92);
}

float profile(vec3 p) {
    float total = 12.0;
    for (int i = 0; i < BASE_PARTS; i++) {
        vec4 ring = BASE[i]; // y, half, radius, edge
        vec2 d = vec2(length(p.xz), abs(p.y - ring.x)) - (ring.zy - ring.w);
        float distance_ = hypot2(d) + min(max(d.x, d.y), 0.0) - ring.w;
        float share = clamp(0.5 + 0.5 * (total - distance_) / BLEND, 0.0, 1.0);
        total = mix(total, distance_, share) - BLEND * share * (1.0 - share);
    }
    return total;
}

// The distance to the base, and how much of the pixel it covers.
float trace(vec3 ray, out float covered) {
    covered = 0.0;
    vec3 middle = vec3(0.0, 0.5 * (BASE[0].x + GROUND), 0.0);
    float toward = dot(middle - origin, ray);
    if (length(origin + toward * ray - middle) > 1.05) return 12.0;
    float t = max(toward - 1.1, 0.0), nearest = 1e6, at = 12.0;
    int steps = 0;
    for (; steps < 70 && t < toward + 1.1; steps++) {
        float d = profile(origin + t * ray);
        if (d < 0.002) {
            covered = 1.0;
            return t;
        }
        float pixels = d * focal.x / t;
        if (pixels < nearest) {
            nearest = pixels;
            at = t;
        }
        t += d;
    }
    if (steps == 70) { // it passes close to an edge, in many small steps
        covered = 1.0;
        return t;
    }
    covered = 1.0 - clamp(nearest, 0.0, 1.0);
    return at;
}

vec3 baseLight(vec3 ray, float t) {
    vec3 p = origin + t * ray;
    vec2 e = vec2(2e-3, 0.0);
    vec3 normal = normalize(vec3(
        profile(p + e.xyy) - profile(p - e.xyy),
        profile(p + e.yxy) - profile(p - e.yxy),
        profile(p + e.yyx) - profile(p - e.yyx)));
    float waves = 0.5 * sin(5.1 * p.y + 3.0 * p.x) + 0.3 * sin(9.7 * p.z + 4.1 * p.y);
    float rings = sin(34.0 * (p.x * 0.9 + 0.35 * p.z + 0.06 * p.y + 0.07 * waves));
    float fibres = sin(57.0 * p.x + 9.0 * waves) * sin(43.0 * p.z - 6.0 * p.y);
    vec3 albedo = mix(WOOD[0], WOOD[1], clamp(0.5 + 0.35 * rings + 0.15 * fibres, 0.0, 1.0));
    float gloss = 0.03;
    vec2 on = vec2(atan(p.x, -p.z) / PLATE.x, (p.y - PLATE_Y) / PLATE.y);
    float aspect = PLATE.x * BASE[1].z / PLATE.y;
    float corner = hypot2(abs(on) * vec2(aspect, 1.0) - vec2(aspect - 0.3, 0.7));
    float metal = smooth_(0.30, 0.26, corner) * step(abs(on.x), 1.0) * step(0.74, length(p.xz));
    if (metal > 0.0) {
        float engraved = 0.85 * texture(plate, 0.5 * on + 0.5).r;
        float frame = 0.5 * smooth_(0.19, 0.21, corner) * smooth_(0.25, 0.23, corner);
        vec3 brass = BRASS * (1.0 - max(engraved, frame)) * (0.9 + 0.1 * sin(700.0 * p.y));
        albedo = mix(albedo, 0.75 * brass, metal);
        gloss += 0.45 * metal * (1.0 - engraved);
    }
    vec3 light = turn * LIGHT;
    float diffuse = 1.5 * max(dot(normal, light), 0.0);
    float ambient = 0.22 + 0.20 * max(-normal.y, 0.0);
    float open_ = clamp(profile(p + 0.09 * normal) / 0.09, 0.0, 1.0);
    ambient *= (0.35 + 0.65 * open_) * (0.45 + 0.55 * smooth_(GROUND, GROUND - 0.14, p.y));
    float facing = clamp(-dot(ray, normal), 0.0, 1.0);
    float mirror = (gloss + (1.0 - gloss) * 0.12 * pow(1.0 - facing, 5.0)) * open_;
    vec3 shine = environment(reflect(ray, normal) * turn) * mirror * (gloss > 0.3 ? BRASS : vec3(1.0));
    return albedo * (diffuse * (0.4 + 0.6 * open_) + ambient) + 0.8 * shine;
}

void main() {
    float fromMiddle, enter, leave, toFloor, radius, solid;
    vec3 ray = rayOfPixel(fromMiddle);
    vec3 light = toLinear(texture(inside, gl_FragCoord.xy / size).rgb);
    float covered = glassOf(ray, enter, leave);
    vec3 entry = origin + enter * ray;
    bool glass = covered > 0.0 && entry.y < FLOOR;
    if (glass) {
        float facing = clamp(-dot(entry, ray), 0.0, 1.0);
        float edge = 1.0 - facing;
        float fresnel = FRESNEL + (1.0 - FRESNEL) * pow(edge, 5.0);
        float dim = 1.0 - 0.38 * edge * edge * edge - 0.35 * smooth_(0.86, 1.0, edge);
        vec3 mirror = environment(reflect(ray, entry) * turn) * fresnel;
        mirror += 0.006 * environment(reflect(ray, origin + leave * ray) * turn) * (1.0 - fresnel);
        light = mix(light, light * dim * (1.0 - fresnel) + mirror, covered);
    }
    bool floor_ = covered > 0.0 && onFloor(ray, leave, toFloor, radius);
    float t = trace(ray, solid);
    if (solid > 0.0 && t < (glass ? enter : 12.0) && !(floor_ && toFloor < t)) {
        light = mix(light, baseLight(ray, t), solid);
    }
    color = vec4(toSrgb(light), 1.0);
}
