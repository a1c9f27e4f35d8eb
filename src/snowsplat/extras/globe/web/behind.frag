// What is behind the Gaussians, in sRGB.
out vec4 color;

float shadow(vec3 ray, vec3 light) {
    if (ray.y <= 1e-6) return 0.0;
    vec2 ground = (origin + (GROUND - origin.y) / ray.y * ray).xz;
    float contact = smooth_(1.25, 0.85, length(ground));
    float thrown = smooth_(2.3, 0.3, length(ground + 0.55 * light.xz));
    return 1.0 - (1.0 - 0.75 * contact) * (1.0 - 0.55 * thrown);
}

void main() {
    float fromMiddle, enter, leave, toFloor, radius;
    vec3 ray = rayOfPixel(fromMiddle);
    vec3 behind = mix(BACKGROUND[0], BACKGROUND[1], smooth_(0.1, 1.05, fromMiddle));
    behind *= 1.0 - 0.5 * shadow(ray, turn * LIGHT);
    float covered = glassOf(ray, enter, leave);
    bool floor_ = covered > 0.0 && onFloor(ray, leave, toFloor, radius);
    vec3 air = mix(INSIDE[0], INSIDE[1], smooth_(-1.0, FLOOR, origin.y + leave * ray.y));
    vec3 inside = mix(behind, air, 0.62);
    if (floor_) inside = SNOW * (1.0 - 0.30 * smooth_(0.45, 1.0, radius));
    bool glass = origin.y + enter * ray.y < FLOOR;
    if (glass || floor_) behind = mix(behind, inside, covered);
    color = vec4(toSrgb(behind), 1.0);
}
