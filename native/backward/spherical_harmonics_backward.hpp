// The derivative of spherical_harmonics.hpp.
#pragma once

#include "project/spherical_harmonics.hpp"

namespace splatpilot::SIMD_LEVEL {

// The derivatives of the basis functions by the unit direction, as polynomials in x, y, z.
struct BasisDerivatives {
  F16 x[16], y[16], z[16];
};

SP_INLINE void basis_derivatives(int degree, const F16& x, const F16& y, const F16& z,
                                 BasisDerivatives& b) {
  const F16 zero = F16(0.0f), one = F16(1.0f), two = F16(2.0f), three = F16(3.0f);
  const auto set = [&](int k, float scale, const F16& dx, const F16& dy, const F16& dz) {
    b.x[k] = F16(scale) * dx;
    b.y[k] = F16(scale) * dy;
    b.z[k] = F16(scale) * dz;
  };
  set(0, kSh00, zero, zero, zero);
  if (degree == 0) return;
  set(1, -kSh1, zero, one, zero);
  set(2, kSh1, zero, zero, one);
  set(3, -kSh1, one, zero, zero);
  if (degree == 1) return;
  set(4, kSh21, y, x, zero);
  set(5, -kSh21, zero, z, y);
  set(6, kSh20, -(two * x), -(two * y), F16(4.0f) * z);
  set(7, -kSh21, z, zero, x);
  set(8, kSh22, two * x, -(two * y), zero);
  if (degree == 2) return;
  const F16 xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  const F16 six = F16(6.0f), eight = F16(8.0f), ring = F16(4.0f) * zz - xx - yy;
  set(9, -kSh33, six * xy, three * (xx - yy), zero);
  set(10, kSh32, yz, xz, xy);
  set(11, -kSh31, -(two * xy), ring - two * yy, eight * yz);
  set(12, kSh30, -(six * xz), -(six * yz), six * zz - three * (xx + yy));
  set(13, -kSh31, ring - two * xx, -(two * xy), eight * xz);
  set(14, 0.5f * kSh32, two * xz, -(two * yz), xx - yy);
  set(15, -kSh33, three * (xx - yy), -(six * xy), zero);
}

// `coefficients` as in evaluate_sh; writes dL/d(coefficients) over them and adds dL/d(x, y, z).
SP_INLINE void evaluate_sh_backward(int degree, float* coefficients, F16 x, F16 y, F16 z,
                                    const F16 color_gradient[3], F16 direction_gradient[3]) {
  const F16 scale = inverse_length(x, y, z);
  x = x * scale;
  y = y * scale;
  z = z * scale;
  F16 basis[16];
  BasisDerivatives b;
  const int count = sh_basis(degree, x, y, z, basis);
  basis_derivatives(degree, x, y, z, b);
  F16 d[3] = {F16(0.0f), F16(0.0f), F16(0.0f)};
  for (int k = 0; k < count; ++k) {
    F16 along = F16(0.0f);
    for (int c = 0; c < 3; ++c) {
      float* coefficient = coefficients + (3 * k + c) * kLanes;
      along += color_gradient[c] * load(coefficient);
      store(coefficient, color_gradient[c] * basis[k]);
    }
    d[0] += along * b.x[k];
    d[1] += along * b.y[k];
    d[2] += along * b.z[k];
  }
  const F16 radial = d[0] * x + d[1] * y + d[2] * z;
  direction_gradient[0] += (d[0] - radial * x) * scale;
  direction_gradient[1] += (d[1] - radial * y) * scale;
  direction_gradient[2] += (d[2] - radial * z) * scale;
}

}  // namespace splatpilot::SIMD_LEVEL
