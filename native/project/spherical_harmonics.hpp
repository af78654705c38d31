// Colours from real spherical harmonics of degree 0 to 3, in the order and with the signs that
// Gaussian-splat files use.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

// colour = max(0, 1/2 + sum_k c_k Y_k(d)) for 16 Gaussians. `coefficients` holds 3 K packs, channel
// fastest; (x, y, z) is the direction from the camera to the Gaussian, of any length.
SP_INLINE void evaluate_sh(int degree, const float* coefficients, F16 x, F16 y, F16 z,
                           F16 color[3]) {
  F16 basis[16];
  int count = 1;
  basis[0] = F16(0.28209479177387814f);
  if (degree > 0) {
    const F16 inverse_length = F16(1.0f) / sqrt(max(x * x + y * y + z * z, F16(1e-30f)));
    x = x * inverse_length;
    y = y * inverse_length;
    z = z * inverse_length;
    count = 4;
    basis[1] = F16(-0.4886025119029199f) * y;
    basis[2] = F16(0.4886025119029199f) * z;
    basis[3] = F16(-0.4886025119029199f) * x;
  }
  const F16 xx = x * x, yy = y * y, zz = z * z;
  if (degree > 1) {
    count = 9;
    basis[4] = F16(1.0925484305920792f) * x * y;
    basis[5] = F16(-1.0925484305920792f) * y * z;
    basis[6] = F16(0.31539156525252005f) * (F16(2.0f) * zz - xx - yy);
    basis[7] = F16(-1.0925484305920792f) * x * z;
    basis[8] = F16(0.5462742152960396f) * (xx - yy);
  }
  if (degree > 2) {
    count = 16;
    basis[9] = F16(-0.5900435899266435f) * y * (F16(3.0f) * xx - yy);
    basis[10] = F16(2.890611442640554f) * x * y * z;
    basis[11] = F16(-0.4570457994644658f) * y * (F16(4.0f) * zz - xx - yy);
    basis[12] = F16(0.3731763325901154f) * z * (F16(2.0f) * zz - F16(3.0f) * (xx + yy));
    basis[13] = F16(-0.4570457994644658f) * x * (F16(4.0f) * zz - xx - yy);
    basis[14] = F16(1.445305721320277f) * z * (xx - yy);
    basis[15] = F16(-0.5900435899266435f) * x * (xx - F16(3.0f) * yy);
  }
  for (int c = 0; c < 3; ++c) color[c] = F16(0.5f);
  for (int k = 0; k < count; ++k) {
    for (int c = 0; c < 3; ++c) color[c] += basis[k] * load(coefficients + (3 * k + c) * kLanes);
  }
  for (int c = 0; c < 3; ++c) color[c] = max(color[c], F16(0.0f));
}

}  // namespace splatpilot::SIMD_LEVEL
