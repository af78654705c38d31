// Derivatives of the spherical harmonics of spherical_harmonics.hpp.
#pragma once

#include "projection.hpp"

namespace flysplat::FLYSPLAT_LEVEL {

// Values of the basis at d / |d| and their derivatives with respect to d.
FS_INLINE void sh_basis_and_slope(int degree, const Vector16& d, F16 basis[16],
                                  Vector16 slope[16]) {
  const F16 inverse_length = F16(1.0f) / sqrt(max(d.x * d.x + d.y * d.y + d.z * d.z, F16(1e-30f)));
  const F16 x = d.x * inverse_length, y = d.y * inverse_length, z = d.z * inverse_length;
  const F16 zero = F16(0.0f), two = F16(2.0f), three = F16(3.0f), four = F16(4.0f);
  const F16 xx = x * x, yy = y * y, zz = z * z;
  const int count = (degree + 1) * (degree + 1);
  // The polynomials without their factors, then with them.
  const F16 p[16] = {F16(1.0f), y, z, x, x * y, y * z, two * zz - xx - yy, x * z, xx - yy,
                     y * (three * xx - yy), x * y * z, y * (four * zz - xx - yy),
                     z * (two * zz - three * (xx + yy)), x * (four * zz - xx - yy), z * (xx - yy),
                     x * (xx - three * yy)};
  const F16 six = F16(6.0f), eight = F16(8.0f);
  const Vector16 dp[16] = {
      {zero, zero, zero},
      {zero, F16(1.0f), zero},
      {zero, zero, F16(1.0f)},
      {F16(1.0f), zero, zero},
      {y, x, zero},
      {zero, z, y},
      {-(two * x), -(two * y), four * z},
      {z, zero, x},
      {two * x, -(two * y), zero},
      {six * x * y, three * (xx - yy), zero},
      {y * z, x * z, x * y},
      {-(two * x * y), four * zz - xx - three * yy, eight * y * z},
      {-(six * x * z), -(six * y * z), six * zz - three * (xx + yy)},
      {four * zz - three * xx - yy, -(two * x * y), eight * x * z},
      {two * x * z, -(two * y * z), xx - yy},
      {three * (xx - yy), -(six * x * y), zero}};
  const float factor[16] = {
      0.28209479177387814f, -0.4886025119029199f, 0.4886025119029199f,  -0.4886025119029199f,
      1.0925484305920792f,  -1.0925484305920792f, 0.31539156525252005f, -1.0925484305920792f,
      0.5462742152960396f,  -0.5900435899266435f, 2.890611442640554f,   -0.4570457994644658f,
      0.3731763325901154f,  -0.4570457994644658f, 1.445305721320277f,   -0.5900435899266435f};
  for (int k = 0; k < count; ++k) {
    basis[k] = F16(factor[k]) * p[k];
    const F16 along = dp[k].x * x + dp[k].y * y + dp[k].z * z;
    const F16 f = F16(factor[k]) * inverse_length;
    slope[k] = {f * (dp[k].x - along * x), f * (dp[k].y - along * y), f * (dp[k].z - along * z)};
  }
}

}  // namespace flysplat::FLYSPLAT_LEVEL
