in vec2 offset;
flat in vec4 splat;
out vec4 color;

void main() {
    float alpha = min(splat.a * exp(-0.5 * dot(offset, offset)), 0.99);
    if (alpha < 1.0 / 255.0) discard;
    color = vec4(splat.rgb * alpha, alpha);
}
