// The derivative of spherical_harmonics.hpp.
#pragma once

#include "project/spherical_harmonics.hpp"

namespace splatpilot::SIMD_LEVEL {

// Basis functions and their derivatives by the unit direction, as polynomials in x, y, z.
struct BasisDerivatives {
  F16 value[16], x[16], y[16], z[16];
};

SP_INLINE int basis_derivatives(int degree, const F16& x, const F16& y, const F16& z,
                                BasisDerivatives& b) {
  const F16 zero = F16(0.0f), two = F16(2.0f), three = F16(3.0f), four = F16(4.0f);
  const auto set = [&](int k, float scale, const F16& value, const F16& dx, const F16& dy,
                       const F16& dz) {
    b.value[k] = F16(scale) * value;
    b.x[k] = F16(scale) * dx;
    b.y[k] = F16(scale) * dy;
    b.z[k] = F16(scale) * dz;
  };
  const F16 one = F16(1.0f);
  set(0, 0.28209479177387814f, one, zero, zero, zero);
  if (degree == 0) return 1;
  set(1, -0.4886025119029199f, y, zero, one, zero);
  set(2, 0.4886025119029199f, z, zero, zero, one);
  set(3, -0.4886025119029199f, x, one, zero, zero);
  if (degree == 1) return 4;
  const F16 xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  set(4, 1.0925484305920792f, xy, y, x, zero);
  set(5, -1.0925484305920792f, yz, zero, z, y);
  set(6, 0.31539156525252005f, two * zz - xx - yy, -(two * x), -(two * y), four * z);
  set(7, -1.0925484305920792f, xz, z, zero, x);
  set(8, 0.5462742152960396f, xx - yy, two * x, -(two * y), zero);
  if (degree == 2) return 9;
  const F16 six = F16(6.0f);
  set(9, -0.5900435899266435f, y * (three * xx - yy), six * xy, three * (xx - yy), zero);
  set(10, 2.890611442640554f, xy * z, yz, xz, xy);
  const F16 ring = four * zz - xx - yy;
  set(11, -0.4570457994644658f, y * ring, -(two * xy), ring - two * yy, F16(8.0f) * yz);
  set(12, 0.3731763325901154f, z * (two * zz - three * (xx + yy)), -(six * xz), -(six * yz),
      six * zz - three * (xx + yy));
  set(13, -0.4570457994644658f, x * ring, ring - two * xx, -(two * xy), F16(8.0f) * xz);
  set(14, 1.445305721320277f, z * (xx - yy), two * xz, -(two * yz), xx - yy);
  set(15, -0.5900435899266435f, x * (xx - three * yy), three * (xx - yy), -(six * xy), zero);
  return 16;
}

// `coefficients` as in evaluate_sh; writes dL/d(coefficients) over them and adds dL/d(x, y, z).
SP_INLINE void evaluate_sh_backward(int degree, float* coefficients, F16 x, F16 y, F16 z,
                                    const F16 color_gradient[3], F16 direction_gradient[3]) {
  const F16 inverse_length = F16(1.0f) / sqrt(max(x * x + y * y + z * z, F16(1e-30f)));
  x = x * inverse_length;
  y = y * inverse_length;
  z = z * inverse_length;
  BasisDerivatives b;
  const int count = basis_derivatives(degree, x, y, z, b);
  F16 d[3] = {F16(0.0f), F16(0.0f), F16(0.0f)};
  for (int k = 0; k < count; ++k) {
    F16 along = F16(0.0f);
    for (int c = 0; c < 3; ++c) {
      float* coefficient = coefficients + (3 * k + c) * kLanes;
      along += color_gradient[c] * load(coefficient);
      store(coefficient, color_gradient[c] * b.value[k]);
    }
    d[0] += along * b.x[k];
    d[1] += along * b.y[k];
    d[2] += along * b.z[k];
  }
  const F16 radial = d[0] * x + d[1] * y + d[2] * z;
  direction_gradient[0] += (d[0] - radial * x) * inverse_length;
  direction_gradient[1] += (d[1] - radial * y) * inverse_length;
  direction_gradient[2] += (d[2] - radial * z) * inverse_length;
}

}  // namespace splatpilot::SIMD_LEVEL
