// Colors from real spherical harmonics of degree 0 to 3, in the order and signs of Gaussian-splat
// files, and their derivatives.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

// Factors of the polynomials, by degree and by the magnitude of the order.
constexpr float kSh00 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
constexpr float kSh20 = 0.31539156525252005f, kSh21 = 1.0925484305920792f;
constexpr float kSh22 = 0.5462742152960396f;
constexpr float kSh30 = 0.3731763325901154f, kSh31 = 0.4570457994644658f;
constexpr float kSh32 = 2.890611442640554f, kSh33 = 0.5900435899266435f;

// Writes the basis functions of a unit direction and returns their number.
SP_INLINE int sh_basis(int degree, const F16& x, const F16& y, const F16& z, F16 basis[16]) {
  basis[0] = F16(kSh00);
  if (degree < 1) return 1;
  basis[1] = F16(-kSh1) * y;
  basis[2] = F16(kSh1) * z;
  basis[3] = F16(-kSh1) * x;
  if (degree < 2) return 4;
  const F16 xx = x * x, yy = y * y, zz = z * z;
  basis[4] = F16(kSh21) * x * y;
  basis[5] = F16(-kSh21) * y * z;
  basis[6] = F16(kSh20) * (F16(2.0f) * zz - xx - yy);
  basis[7] = F16(-kSh21) * x * z;
  basis[8] = F16(kSh22) * (xx - yy);
  if (degree < 3) return 9;
  basis[9] = F16(-kSh33) * y * (F16(3.0f) * xx - yy);
  basis[10] = F16(kSh32) * x * y * z;
  basis[11] = F16(-kSh31) * y * (F16(4.0f) * zz - xx - yy);
  basis[12] = F16(kSh30) * z * (F16(2.0f) * zz - F16(3.0f) * (xx + yy));
  basis[13] = F16(-kSh31) * x * (F16(4.0f) * zz - xx - yy);
  basis[14] = F16(0.5f * kSh32) * z * (xx - yy);
  basis[15] = F16(-kSh33) * x * (xx - F16(3.0f) * yy);
  return 16;
}

SP_INLINE F16 inverse_length(const F16& x, const F16& y, const F16& z) {
  return F16(1.0f) / sqrt(max(x * x + y * y + z * z, F16(1e-30f)));
}

// color = max(0, 1/2 + sum_k c_k Y_k(d)) for 16 Gaussians. `coefficients` holds 3 K packs, channel
// fastest; (x, y, z) is the direction from the camera to the Gaussian, of any length.
SP_INLINE void evaluate_sh(int degree, const float* coefficients, const F16& x, const F16& y,
                           const F16& z, F16 color[3]) {
  F16 basis[16];
  const F16 scale = degree > 0 ? inverse_length(x, y, z) : F16(1.0f);
  const int count = sh_basis(degree, x * scale, y * scale, z * scale, basis);
  for (int c = 0; c < 3; ++c) color[c] = F16(0.5f);
  for (int k = 0; k < count; ++k) {
    for (int c = 0; c < 3; ++c) color[c] += basis[k] * load(coefficients + (3 * k + c) * kLanes);
  }
  for (int c = 0; c < 3; ++c) color[c] = max(color[c], F16(0.0f));
}

// The derivatives of the basis by the unit direction, as polynomials in x, y, z.
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
