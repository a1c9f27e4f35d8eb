// One quad for each Gaussian, from back to front. snowsplat/extras/globe/flakes.py describes how a Gaussian
// becomes a flake; the projection is that of snowsplat (EWA splatting).
uniform mat3 camera; // globe -> camera
uniform vec3 eye; // position of the camera
uniform vec2 centre, focal, size; // pixels
uniform highp sampler2D state; // x y z, angle and morph
uniform highp sampler2D parameters; // six texels for each Gaussian
in uint index;
in vec2 corner;
out vec2 offset; // in standard deviations
flat out vec4 splat; // colour, opacity

vec4 fetch(highp sampler2D data, int at) {
    int width = textureSize(data, 0).x;
    return texelFetch(data, ivec2(at % width, at / width), 0);
}

vec4 product(vec4 a, vec4 b) { // of quaternions w x y z
    return vec4(
        a.x * b.x - dot(a.yzw, b.yzw),
        a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

mat3 rotation(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
    int i = int(index);
    vec4 now = fetch(state, i);
    vec4 a = fetch(parameters, 6 * i), quat = fetch(parameters, 6 * i + 1);
    vec4 base = fetch(parameters, 6 * i + 2), alongY = fetch(parameters, 6 * i + 3);
    vec4 alongZ = fetch(parameters, 6 * i + 4), alongX = fetch(parameters, 6 * i + 5);
    float morph = fract(now.w) / 0.999;
    float angle = floor(now.w) * (6.283185307 / 4096.0);
    vec3 scales = exp(mix(a.xyz, clamp(a.xyz, log(FLAKE.x), log(FLAKE.y)), morph));
    float opacity = mix(a.w, max(a.w, OPAQUE), morph);

    gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // not visible
    vec3 p = camera * (now.xyz - eye);
    if (p.z < 0.05) return;
    float azimuth = base.w, height = alongY.w; // the axis around which the flake turns
    vec3 axis = vec3(vec2(cos(azimuth), sin(azimuth)) * sqrt(1.0 - height * height), height);
    vec4 spin = vec4(cos(0.5 * angle), sin(0.5 * angle) * axis);
    mat3 factor = camera * rotation(product(spin, normalize(quat)));
    factor = mat3(factor[0] * scales.x, factor[1] * scales.y, factor[2] * scales.z);
    vec2 slope = p.xy / p.z;
    // Rows of the Jacobian of the projection.
    vec3 jx = vec3(focal.x, 0.0, -focal.x * slope.x) / p.z;
    vec3 jy = vec3(0.0, focal.y, -focal.y * slope.y) / p.z;
    vec3 fx = jx * factor, fy = jy * factor;
    float d = ANTIALIASED ? 0.1 : 0.3; // pixels^2
    float xx = dot(fx, fx) + d, yy = dot(fy, fy) + d, xy = dot(fx, fy);
    if (ANTIALIASED) {
        vec3 normal = cross(fx, fy); // det(U Uᵀ) = |U₀ × U₁|²
        opacity *= sqrt(dot(normal, normal) / (xx * yy - xy * xy));
    }
    float middle = 0.5 * (xx + yy);
    float radius = length(vec2(0.5 * (xx - yy), xy));
    float large = middle + radius, small = max(middle - radius, 0.05);
    vec2 direction = abs(xy) > 1e-6 ? normalize(vec2(xy, large - xx))
        : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
    float reach = sqrt(max(2.0 * log(255.0 * opacity), 0.0));
    offset = corner * reach;
    vec2 pixel = focal * slope + centre
        + offset.x * sqrt(large) * direction
        + offset.y * sqrt(small) * vec2(-direction.y, direction.x);
    gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);

    vec3 view = normalize(now.xyz - eye);
    vec3 light = C1 * (alongZ.rgb * view.z - alongY.rgb * view.y - alongX.rgb * view.x);
    float most = max(base.r, max(base.g, base.b));
    vec3 flake = mix(base.rgb / clamp(most, 1.0 / BRIGHTER, 1.0), vec3(1.0), WHITE);
    splat.rgb = mix(base.rgb + light, flake, morph);
    splat = vec4(max(splat.rgb, 0.0), opacity);
}
