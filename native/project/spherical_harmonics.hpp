// Colors from real spherical harmonics of degree 0 to 3, in the order and with the signs that
// Gaussian-splat files use.
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

}  // namespace splatpilot::SIMD_LEVEL
