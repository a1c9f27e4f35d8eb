"""Faults in the kernels, written by hand, with a description and the tests that must detect them.

The original text of a fault must occur exactly once in its file. mutate_kernels.py reports entries
that no longer match the sources.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """In a file of ``native/``, the text ``becomes`` replaces the text ``was``."""

    file: str  # relative to native/
    was: str
    becomes: str
    breaks: str  # what is wrong with the fault, for the report
    tests: str  # the tests that must detect it: a file of tests/ops, without test_ and .py


FAULTS = (
    # The projection
    Fault("projection.h", "Real(0.15) * w", "Real(0.25) * w", "limit of J in x", "project"),
    Fault(
        "projection.h",
        "max_ty = T((h - centre_y + beyond_y) / focal_y)",
        "max_ty = T((h - centre_y) / focal_y)",
        "limit of J below the image",
        "project",
    ),
    Fault(
        "projection.h",
        "position[k] = -(rotation[k] * translation[0]",
        "position[k] = (rotation[k] * translation[0]",
        "centre of the camera, so the view direction",
        "project",
    ),
    Fault(
        "projection.h",
        "R[5] = two * (y * z - w * x);",
        "R[5] = two * (y * z + w * x);",
        "rotation of a quaternion",
        "project",
    ),
    Fault(
        "projection.h",
        "z * (dR[3] - dR[1]));\n  dq[1]",
        "z * (dR[3] + dR[1]));\n  dq[1]",
        "gradient of a quaternion's w",
        "project",
    ),
    Fault(
        "projection.h",
        "two * z * (dR[0] + dR[4]));",
        "two * z * (dR[0] - dR[4]));",
        "gradient of a quaternion's z",
        "project",
    ),
    Fault(
        "projection.h",
        "const Real j02 = -(j00 * p.tx), j12 = -(j11 * p.ty);\n  for (int k = 0; k < 3; k++) {\n"
        "    p.T[k]",
        "const Real j02 = -(j00 * u), j12 = -(j11 * p.ty);\n  for (int k = 0; k < 3; k++) {\n"
        "    p.T[k]",
        "J in x is not limited",
        "project",
    ),
    Fault(
        "projection.h",
        "U[2] * U[2] + Real(kDilation);",
        "U[2] * U[2];",
        "low-pass filter in x",
        "project",
    ),
    Fault(
        "projection.h",
        "dilation * (p.cov_xx + p.cov_yy - dilation));",
        "dilation * (p.cov_xx + p.cov_yy + dilation));",
        "determinant of the 2D covariance",
        "project",
    ),
    Fault(
        "projection.h",
        "p.conic[1] = -(p.cov_xy * p.inv_det);",
        "p.conic[1] = p.cov_xy * p.inv_det;",
        "sign of a conic's b",
        "project",
    ),
    Fault(
        "projection.h",
        "grad.opacity_logit = d.opacity * p.opacity * (Real(1.f) - p.opacity);",
        "grad.opacity_logit = d.opacity * p.opacity;",
        "gradient of the sigmoid",
        "project",
    ),
    Fault(
        "projection.h",
        "gb = half * d.conic[1]",
        "gb = d.conic[1]",
        "gradient of a conic's b",
        "project",
    ),
    Fault(
        "projection.h",
        "fx * d.mean2d[0] - select(free_x, dj02 * fx * iz, zero)",
        "fx * d.mean2d[0] - dj02 * fx * iz",
        "gradient through J where it is limited",
        "project",
    ),
    Fault(
        "projection.h",
        "const Real dz = d.depth - iz *",
        "const Real dz = -iz *",
        "gradient of the depth",
        "project",
    ),
    Fault(
        "projection.h",
        "grad.quat[k] = (dq[k] - radial * p.quat[k]) * p.inv_quat_norm;",
        "grad.quat[k] = dq[k] * p.inv_quat_norm;",
        "gradient of normalising a quaternion",
        "project",
    ),
    Fault(
        "projection.h",
        "pose->rotation[6 + k] += j02 * dT[k] + j12 * dT[3 + k];",
        "pose->rotation[6 + k] += j02 * dT[k];",
        "gradient of the pose",
        "project",
    ),
    Fault(
        "projection.h",
        "(p.mean2d[1] + ey >= half)",
        "(p.mean2d[1] >= half)",
        "visibility above the image",
        "project",
    ),
    Fault(
        "projection.h",
        "column[7] = Real(3.f) * sqrt(",
        "column[7] = Real(2.f) * sqrt(",
        "radius of a splat",
        "project",
    ),
    Fault(
        "cpu/project.cpp",
        "const V k2(T(2.02 * kLn255));",
        "const V k2(T(0.5 * kLn255));",
        "first test of visibility is too strict",
        "project",
    ),
    Fault(
        "cpu/project.cpp",
        "for (int k = 0; k < 3; k++) color[k] = max(color[k], V(0.f));",
        "",
        "colours may be negative",
        "project",
    ),
    Fault(
        "cpu/gaussian_rows.h",
        "out.shape.mean[k] += d_mean[k];",
        "",
        "gradient of a mean through the colour",
        "project",
    ),
    # Spherical harmonics
    Fault(
        "sh.h",
        "(four * zz - xx - yy);\n  Y[12]",
        "(three * zz - xx - yy);\n  Y[12]",
        "spherical harmonic Y₁₁",
        "project",
    ),
    Fault("sh.h", "Y[1] = c(-kSH1) * y", "Y[1] = c(kSH1) * y", "sign of Y₁", "project"),
    Fault(
        "sh.h",
        "c(-2 * kSH3[4]) * xy * d[13]",
        "c(2 * kSH3[4]) * xy * d[13]",
        "gradient of Y₁₃",
        "project",
    ),
    Fault(
        "sh.h",
        "select(color[ch] >= Real(0.f), d_color[ch], Real(0.f))",
        "d_color[ch]",
        "gradient where a colour is clamped",
        "project",
    ),
    Fault(
        "sh.h",
        "d_mean[1] = (g[1] - radial * dir.y) * dir.inv_length;",
        "d_mean[1] = g[1] * dir.inv_length;",
        "gradient of normalising the view direction",
        "project",
    ),
    # Compositing
    Fault(
        "portable.h",
        "constexpr double kMaxAlpha = 0.99;",
        "constexpr double kMaxAlpha = 0.999;",
        "cap of α",
        "rasterize",
    ),
    Fault(
        "portable.h",
        "constexpr double kMinTransmittance = 1e-4;",
        "constexpr double kMinTransmittance = 1e-3;",
        "pixels end too early",
        "rasterize",
    ),
    Fault(
        "portable.h",
        "constexpr double kLog2MinAlpha = -7.994353436858858;",
        "constexpr double kLog2MinAlpha = -7.0;",
        "faint splats are skipped",
        "rasterize",
    ),
    Fault(
        "rasterize.h",
        "return log2_alpha >= Real(kLog2MinAlpha);",
        "return log2_alpha >= Real(kLog2MinAlpha - 0.1);",
        "too faint splats are blended",
        "rasterize",
    ),
    Fault(
        "rasterize.h",
        "return weighted_dot - alpha * behind *",
        "return weighted_dot + alpha * behind *",
        "gradient of α from what is behind",
        "rasterize",
    ),
    Fault(
        "rasterize.h",
        "d_mean[1] = conic[1] * m.qx + conic[2] * m.qy;",
        "d_mean[1] = conic[2] * m.qy;",
        "gradient of a 2D mean",
        "rasterize",
    ),
    Fault(
        "rasterize.h",
        "d_conic[1] = -m.qxy;",
        "d_conic[1] = Real(-0.5f) * m.qxy;",
        "gradient of a conic's b",
        "rasterize",
    ),
    Fault(
        "rasterize.h",
        "s.slope_x = -(conic[1] / conic[0]);",
        "s.slope_x = conic[1] / conic[0];",
        "culling of tilted splats",
        "rasterize",
    ),
    Fault(
        "rasterize.h",
        "return max(on_row, on_column);",
        "return min(on_row, on_column);",
        "culling of tiles is too strict",
        "rasterize",
    ),
    Fault(
        "rasterize.h",
        "x0 = max(x - ex - half, zero)",
        "x0 = max(x - ey - half, zero)",
        "first tile of a splat",
        "tiling",
    ),
    Fault(
        "rasterize.h",
        "return b >> 31 ? ~b : b | 0x80000000u;",
        "return b;",
        "order of negative depths",
        "tiling",
    ),
    Fault(
        "cpu/rasterize.cpp",
        "rest = select(open, next, rest);",
        "rest = select(open, next, V(0.f));",
        "light that is left in pixels that ended earlier",
        "rasterize",
    ),
    Fault(
        "cpu/rasterize.cpp",
        "const V rest = block[b].rest;",
        "const V rest = block[b].transmittance;",
        "background behind finished pixels",
        "rasterize",
    ),
    Fault(
        "cpu/rasterize.cpp",
        "behind += block[b].grad_alpha * V::load_first(alpha + at, n);",
        "",
        "gradient through alpha",
        "rasterize",
    ),
    Fault(
        "cpu/rasterize.cpp",
        "zero_unless(open & (e < max_alpha), log_alpha_gradient",
        "zero_unless(open, log_alpha_gradient",
        "gradient where α is capped",
        "rasterize",
    ),
    Fault(
        "cpu/rasterize.cpp",
        "sums[C + 4] += qy * dx",
        "sums[C + 4] += qx * dx",
        "moment q dx dy",
        "rasterize",
    ),
    Fault(
        "cpu/rasterize.cpp",
        "(1.0 - double(alpha[x]))",
        "1.0",
        "gradient of the background",
        "rasterize",
    ),
    Fault(
        "cpu/tiles.cpp",
        "out[at] = pass == 0 ? uint32_t(i) : in[i];",
        "out[at] = uint32_t(i);",
        "sorting by more than one digit",
        "tiling",
    ),
    Fault(
        "cpu/tiles.cpp",
        "if (w > 0 && w * h <= 16) {",
        "if (w > 0 && w <= 16) {",
        "splats of more than 16 tiles",
        "tiling",
    ),
    Fault(
        "cpu/tiles.cpp",
        "slot_range[2 * splat + 1] = slot;",
        "slot_range[2 * splat + 1] = slot - (slot > first_slot);",
        "the last tile of a splat is not summed",
        "rasterize",
    ),
    Fault(
        "simd_math.h",
        "p = p * f + V(0.24168065f);",
        "p = p * f + V(0.2416f);",
        "exp2 of blending",
        "rasterize",
    ),
    Fault(
        "simd_math.h",
        "p = p * t2 + V(0.96179669f);",
        "",
        "log2",
        "rasterize",
    ),
    # The loss
    Fault("ssim.h", "kSsimC2 = 0.03 * 0.03", "kSsimC2 = 0.02 * 0.02", "constant C₂", "photometric"),
    Fault("ssim.h", "x == 1 ? 0.2130055377112537", "x == 1 ? 0.213", "window", "photometric"),
    Fault(
        "ssim.h",
        "d.mean_aa = -(ssim * inverse * l_down);",
        "d.mean_aa = ssim * inverse * l_down;",
        "derivative of the variance",
        "photometric",
    ),
    Fault(
        "cpu/photometric.cpp",
        "V(2.f) * a * terms[1][r]",
        "a * terms[1][r]",
        "gradient through a²",
        "photometric",
    ),
    Fault(
        "cpu/photometric.cpp",
        "select(zero > difference, down, zero)",
        "down",
        "gradient of |0|",
        "photometric",
    ),
    Fault(
        "cpu/photometric.cpp",
        "V::load_bytes(n >= V::width ? p : bytes) * V(1.0 / 255.0);",
        "V::load_bytes(n >= V::width ? p : bytes) * V(1.0 / 256.0);",
        "8-bit targets",
        "photometric",
    ),
    Fault(
        "cpu/photometric.cpp",
        "zero_unless(inside, d.mean_a).store(s.derivatives[r][0] + x);",
        "d.mean_a.store(s.derivatives[r][0] + x);",
        "gradient beyond the border",
        "photometric",
    ),
    # The optimiser
    Fault(
        "adam.h", "gain2(Real(1 - p.beta2))", "gain2(Real(p.beta2))", "second moment", "adam_step"
    ),
    Fault(
        "adam.h",
        "rsqrt(v * inv_correction2 + eps2)",
        "rsqrt(v + eps2)",
        "bias correction",
        "adam_step",
    ),
    Fault(
        "adam.h",
        "return is_finite(v + p);",
        "return is_finite(p);",
        "rows whose moments are not finite",
        "fuzz",
    ),
    Fault(
        "cpu/adam.cpp",
        "if (extra) gradient += V::load_first(extra + c, n);\n      rule.step",
        "rule.step",
        "gradient of a regularizer in the last columns",
        "adam_step",
    ),
    Fault(
        "cpu/adam.cpp",
        "if (visible_only) return;",
        "return;",
        "moments of Gaussians that are not seen",
        "adam_step",
    ),
    Fault(
        "cpu/adam.cpp",
        "if (nonfinite) t.count_nonfinite(1);",
        "if (nonfinite) t.count_nonfinite(2);",
        "count of rows that are not finite",
        "fuzz",
    ),
    Fault(
        "cpu/adam.cpp",
        "if (p.valid && !*p.valid) return 0;",
        "",
        "steps that are not valid",
        "adam_step",
    ),
    # The statistics and the neighbours
    Fault(
        "statistic.h",
        "y = g[1] * half_height;",
        "y = g[1] * half_width;",
        "unit of the gradient in y",
        "statistic",
    ),
    Fault(
        "statistic.h",
        "if (!is_finite(norm)) return;",
        "",
        "gradients that are not finite",
        "fuzz",
    ),
    Fault(
        "statistic.h",
        "max(p.packed[i * p.stride + 7], p.max_radii[row])",
        "p.packed[i * p.stride + 7]",
        "the largest radius",
        "statistic",
    ),
    Fault(
        "cpu/neighbours.cpp",
        "if (away >= q.best[q.k - 1]) return;",
        "if (away >= q.best[0]) return;",
        "search ends too early",
        "neighbours",
    ),
    Fault(
        "cpu/neighbours.cpp",
        "if (i == q.self) continue;",
        "",
        "a point is its own neighbour",
        "neighbours",
    ),
    # The kernels of a GPU
    Fault(
        "cuda/adam.cu",
        "if (splat >= 0) g[j] += gradient",
        "if (splat >= 0) g[j] = gradient",
        "gradient of a regularizer",
        "adam_step",
    ),
    Fault(
        "cuda/adam.cu",
        "nonfinite[threadIdx.x] >> k & 1",
        "nonfinite[threadIdx.x] & 1",
        "count of rows that are not finite",
        "fuzz",
    ),
    Fault(
        "cuda/project.cu",
        "for (int k = 0; k < 3; k++) color[k] = max(color[k], T(0));",
        "",
        "colours may be negative",
        "project",
    ),
    Fault(
        "cuda/project.cu",
        "for (int k = 1; k < kParts; k++) sum += parts[16 * k + int(threadIdx.x)];",
        "for (int k = 2; k < kParts; k++) sum += parts[16 * k + int(threadIdx.x)];",
        "gradient of the pose",
        "project",
    ),
    Fault(
        "cuda/rasterize.cu",
        "if (visible && !open) signed_transmittance = negative(signed_transmittance);",
        "",
        "a finished pixel stays open",
        "rasterize",
    ),
    Fault(
        "cuda/rasterize.cu",
        "q0 += q[j], qx += qd, qxx += qd * d;",
        "q0 += q[j], qx += qd, qxx += qd;",
        "moment q dx²",
        "rasterize",
    ),
    Fault(
        "cuda/statistic.cu",
        "T(0.5 * p.width), T(0.5 * p.height)",
        "T(p.width), T(p.height)",
        "unit of the gradient",
        "statistic",
    ),
)
