"""Constants of the spherical harmonics (SH) that describe view-dependent colour."""

#: The constant basis function, Y_00 = 1 / (2 √π).
SH_C0 = 0.28209479177387814
#: Number of SH coefficients beyond the constant one, for degrees 0, 1, 2, 3.
SH_REST_COUNTS = (0, 3, 8, 15)
