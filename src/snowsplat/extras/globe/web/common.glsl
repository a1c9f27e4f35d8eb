// Shared by the two passes that draw what is around the Gaussians: see snowsplat/extras/globe/glass.py.
uniform mat3 turn; // camera -> globe
uniform vec3 origin; // of the camera
uniform vec2 centre, focal, size; // pixels

vec3 rayOfPixel(out float fromMiddle) {
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
    fromMiddle = length((pixel - 0.5 * size) / focal) / (0.5 * length(size / focal));
    return turn * normalize(vec3((pixel - centre) / focal, 1.0));
}

// smoothstep that also falls: `low` may be above `high`.
float smooth_(float low, float high, float x) {
    float t = clamp((x - low) / (high - low), 0.0, 1.0);
    return t * t * (3.0 - 2.0 * t);
}

vec3 toLinear(vec3 c) {
    return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), vec3(greaterThan(c, vec3(0.04045))));
}

vec3 toSrgb(vec3 c) {
    c = clamp(c, 0.0, 1.0);
    return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, vec3(greaterThan(c, vec3(0.0031308))));
}

// The glass: distances to its front and back, and how much of the pixel it covers.
float glassOf(vec3 ray, out float enter, out float leave) {
    float along = dot(ray, origin);
    float square = dot(origin, origin) - along * along; // of the distance from the centre
    float reach = sqrt(max(1.0 - square, 0.0));
    enter = -along - reach;
    leave = -along + reach;
    return clamp((1.0 - sqrt(square)) * focal.x / -along + 0.5, 0.0, 1.0);
}

bool onFloor(vec3 ray, float leave, out float distance_, out float radius) {
    distance_ = ray.y > 1e-6 ? (FLOOR - origin.y) / ray.y : 1e6;
    radius = length((origin + distance_ * ray).xz) / FLOOR_RADIUS;
    return radius < 1.0 && distance_ < leave + 1e-3;
}
