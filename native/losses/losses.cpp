// The loss kernels of one SIMD level.
#include "losses/losses.hpp"

#include "core/mathematics.hpp"

namespace splatpilot::SIMD_LEVEL {

// L1 and SSIM (Wang et al. 2004: Gaussian window of 11 x 11, sigma 1.5; zeros outside the image).
//
// With u = x + y and v = x - y SSIM takes four windowed means, E[u], E[u^2], E[v] and E[v^2],
// instead of five. Rows are filtered along x, then, once the rows around them are there, along y;
// the gradient's three windowed means follow five rows behind. Only 11 rows are kept, so all stays
// in the cache. A row has width * channels values: along x, the neighbor of a value is `channels`
// away.

constexpr int kWindowRadius = 5;
constexpr int kWindow = 2 * kWindowRadius + 1;
constexpr float kSsimC1 = 0.01f * 0.01f, kSsimC2 = 0.03f * 0.03f;
// exp(-k^2 / (2 * 1.5^2)), normalized to a sum of 1 over k = -5..5.
constexpr float kGaussian[kWindowRadius + 1] = {0.2660117249f,  0.2130055377f,   0.1093606895f,
                                                0.03600077213f, 0.007598758135f, 0.001028380084f};

struct RowLayout {
  size_t values;  // width * channels
  size_t blocks;  // packs in a row
  size_t margin;  // zeros before and after a padded row, at least the reach of the window
  size_t padded;
};

SP_INLINE RowLayout row_layout(int width, int channels) {
  RowLayout l;
  l.values = static_cast<size_t>(width) * channels;
  l.blocks = (l.values + kLanes - 1) / kLanes;
  l.margin = (static_cast<size_t>(kWindowRadius) * channels + kLanes - 1) / kLanes * kLanes;
  l.padded = l.blocks * kLanes + 2 * l.margin;
  return l;
}

static size_t photometric_scratch(int width, int channels) {
  const RowLayout l = row_layout(width, channels);
  return 5 * l.padded + (4 * (kWindow + 1) + 3 * kWindow) * l.blocks * kLanes;
}

// The first `count` lanes of a, zeros after them.
SP_INLINE F16 first_lanes(const F16& a, size_t count) {
  if (count >= kLanes) return a;
  float values[kLanes];
  store(values, a);
  for (size_t k = count; k < kLanes; ++k) values[k] = 0.0f;
  return load(values);
}

SP_INLINE double sum_of(const F16& a) {
  float values[kLanes];
  store(values, a);
  double sum = 0.0;
  for (int k = 0; k < kLanes; ++k) sum += values[k];
  return sum;
}

// Windowed means along x of a padded row at p, and of its square.
SP_INLINE void filter_with_square(const float* p, size_t stride, F16& mean, F16& square) {
  const F16 center = load(p);
  mean = F16(kGaussian[0]) * center;
  square = mean * center;
#pragma GCC unroll 5
  for (int k = 1; k <= kWindowRadius; ++k) {
    const F16 a = load(p - k * stride), b = load(p + k * stride);
    mean += F16(kGaussian[k]) * (a + b);
    square += F16(kGaussian[k]) * (a * a + b * b);
  }
}

SP_INLINE F16 filter_row(const float* p, size_t stride) {
  F16 mean = F16(kGaussian[0]) * load(p);
#pragma GCC unroll 5
  for (int k = 1; k <= kWindowRadius; ++k) {
    mean += F16(kGaussian[k]) * (load(p - k * stride) + load(p + k * stride));
  }
  return mean;
}

// Windowed means along y of the packs at `offset` in 11 rows.
template <int kCount>
SP_INLINE void filter_columns(const float* const* rows, size_t offset, F16* means) {
#pragma GCC unroll 4
  for (int i = 0; i < kCount; ++i) {
    means[i] = F16(kGaussian[0]) * load(rows[kWindowRadius] + offset + i * kLanes);
  }
#pragma GCC unroll 5
  for (int k = 1; k <= kWindowRadius; ++k) {
    const float *above = rows[kWindowRadius - k] + offset,
                *below = rows[kWindowRadius + k] + offset;
#pragma GCC unroll 4
    for (int i = 0; i < kCount; ++i) {
      means[i] += F16(kGaussian[k]) * (load(above + i * kLanes) + load(below + i * kLanes));
    }
  }
}

// Pointers to the 11 rows about `row` in a ring; zeros for those outside the image.
SP_INLINE void rows_about(int row, int height, const float* ring, size_t row_size,
                          const float* zeros, const float** rows) {
  for (int k = -kWindowRadius; k <= kWindowRadius; ++k) {
    const int r = row + k;
    rows[k + kWindowRadius] =
        r < 0 || r >= height ? zeros : ring + static_cast<size_t>(r % kWindow) * row_size;
  }
}

static PhotometricSums photometric(const PhotometricInput& in) {
  const RowLayout l = row_layout(in.width, in.channels);
  const size_t stride = in.channels, moment_row = 4 * l.blocks * kLanes,
               slope_row = 3 * l.blocks * kLanes;
  float* padded[5];  // u and v; the derivatives of SSIM by E[x], E[u^2] / u and E[v^2] / v
  for (int i = 0; i < 5; ++i) padded[i] = in.scratch + i * l.padded + l.margin;
  float* moments = in.scratch + 5 * l.padded;
  float* slopes = moments + kWindow * moment_row;
  float* zeros = slopes + kWindow * slope_row;
  for (size_t i = 0; i < 5 * l.padded; ++i) in.scratch[i] = 0.0f;
  for (size_t i = 0; i < moment_row; ++i) zeros[i] = 0.0f;

  PhotometricSums sums = {0.0, 0.0};
  const float* rows[kWindow];
  const int delay = in.gradient ? 2 * kWindowRadius : kWindowRadius;
  for (int step = 0; step < in.height + delay; ++step) {
    if (step < in.height) {  // along x: E[u], E[u^2], E[v], E[v^2]
      const float *x = in.rendered + step * l.values, *y = in.target + step * l.values;
      F16 absolute = F16(0.0f);
      for (size_t i = 0; i < l.values; i += kLanes) {
        const F16 a = load_first(x + i, l.values - i), b = load_first(y + i, l.values - i);
        const F16 v = a - b;
        store(padded[0] + i, a + b);
        store(padded[1] + i, v);
        absolute += max(v, -v);
      }
      sums.l1 += sum_of(absolute);
      float* out = moments + (step % kWindow) * moment_row;
      for (size_t i = 0; i < l.values; i += kLanes, out += 4 * kLanes) {
        F16 mean, square;
        filter_with_square(padded[0] + i, stride, mean, square);
        store(out, mean);
        store(out + kLanes, square);
        filter_with_square(padded[1] + i, stride, mean, square);
        store(out + 2 * kLanes, mean);
        store(out + 3 * kLanes, square);
      }
    }
    const int middle = step - kWindowRadius;
    if (middle >= 0 && middle < in.height) {  // along y: SSIM and its derivatives
      rows_about(middle, in.height, moments, moment_row, zeros, rows);
      F16 dissimilarity = F16(0.0f);
      for (size_t i = 0; i < l.values; i += kLanes) {
        F16 m[4];
        filter_columns<4>(rows, 4 * i, m);
        const F16 half = F16(0.5f), c1 = F16(kSsimC1), c2 = F16(kSsimC2);
        const F16 uu = m[0] * m[0], vv = m[2] * m[2];
        const F16 var_u = m[1] - uu, var_v = m[3] - vv;
        const F16 inv_b1 = F16(1.0f) / (half * (uu + vv) + c1);
        const F16 inv_b2 = F16(1.0f) / (half * (var_u + var_v) + c2);
        // One minus either factor of SSIM, without the cancellation of 1 - SSIM for similar images.
        const F16 e1 = vv * inv_b1, e2 = var_v * inv_b2;
        dissimilarity += first_lanes(e1 + e2 - e1 * e2, l.values - i);
        if (!in.gradient) continue;
        const F16 one = F16(1.0f), two = F16(2.0f);
        const F16 luminance = one - e1, structure = one - e2;
        const F16 by_uu = luminance * e2 * inv_b2;
        const F16 by_vv = -(luminance * (two - e2) * inv_b2);
        const F16 by_mean = m[0] * (structure * e1 * inv_b1 - by_uu) -
                            m[2] * (structure * (two - e1) * inv_b1 + by_vv);
        store_first(padded[2] + i, by_mean, l.values - i);
        store_first(padded[3] + i, by_uu, l.values - i);
        store_first(padded[4] + i, by_vv, l.values - i);
      }
      sums.dissimilarity += sum_of(dissimilarity);
      if (in.gradient) {
        float* out = slopes + (middle % kWindow) * slope_row;
        for (size_t i = 0; i < l.values; i += kLanes, out += 3 * kLanes) {
          for (int d = 0; d < 3; ++d)
            store(out + d * kLanes, filter_row(padded[2 + d] + i, stride));
        }
      }
    }
    const int last = step - 2 * kWindowRadius;
    if (in.gradient && last >= 0) {
      rows_about(last, in.height, slopes, slope_row, zeros, rows);
      const float *x = in.rendered + last * l.values, *y = in.target + last * l.values;
      float* out = in.gradient + last * l.values;
      for (size_t i = 0; i < l.values; i += kLanes) {
        F16 s[3];
        filter_columns<3>(rows, 3 * i, s);
        const F16 a = load_first(x + i, l.values - i), b = load_first(y + i, l.values - i);
        const F16 v = a - b, l1 = F16(in.l1_scale);
        const F16 sign = zero_unless(v > F16(0.0f), l1) - zero_unless(v < F16(0.0f), l1);
        store_first(out + i, F16(in.ssim_scale) * (s[0] + (a + b) * s[1] + v * s[2]) + sign,
                    l.values - i);
      }
    }
  }
  return sums;
}

// The mean absolute difference of the logarithms of two depth images.
static double log_depth(const LogDepthInput& in) {
  size_t valid_count = 0;
  for (size_t i = 0; i < in.count; ++i) {
    valid_count += in.depth[i] > in.epsilon && in.depth[i] < in.far;
  }
  const float scale = valid_count ? 1.0f / static_cast<float>(valid_count) : 0.0f;
  const float ln2 = 0.69314718056f;

  double sum = 0.0;
  for (size_t i = 0; i < in.count; i += kLanes) {
    const float *rendered = in.rendered + i, *depth = in.depth + i;
    const float* weights = in.weights ? in.weights + i : nullptr;
    const bool whole = i + kLanes <= in.count;
    float last[3][kLanes] = {};  // beyond the end, a depth of 0 is invalid
    if (!whole) {
      for (size_t k = 0; k < in.count - i; ++k) {
        last[0][k] = rendered[k];
        last[1][k] = depth[k];
        last[2][k] = weights ? weights[k] : 1.0f;
      }
      rendered = last[0];
      depth = last[1];
      weights = last[2];
    }
    const F16 d = load(rendered), truth = load(depth);
    const F16 weight = weights ? load(weights) : F16(1.0f);
    const Mask16 valid = (truth > F16(in.epsilon)) & (truth < F16(in.far));
    const F16 clamped = max(F16(in.epsilon), d);
    const F16 difference = log2(clamped / truth) * F16(ln2);
    // log2 hides NaN and infinity; of both, x - x is NaN.
    const F16 loss = weight * max(difference, -difference) + (d - d);
    float values[kLanes];
    store(values, zero_unless(valid, loss));
    for (int k = 0; k < kLanes; ++k) sum += values[k];
    if (!in.gradient) continue;
    const F16 slope = weight * F16(scale) / clamped;
    const Mask16 moves = valid & (d > F16(in.epsilon));
    const F16 gradient =
        zero_unless(moves & (d > truth), slope) - zero_unless(moves & (d < truth), slope);
    if (whole) {
      store(in.gradient + i, gradient);
    } else {
      store(values, gradient);
      for (size_t k = 0; k < in.count - i; ++k) in.gradient[i + k] = values[k];
    }
  }
  return valid_count ? sum / static_cast<double>(valid_count) : 0.0;
}

// Parameters of Gaussians.

// Calls f(start, count) for packs of `count` <= kLanes numbers.
template <typename Function>
SP_INLINE void each_pack(size_t total, const Function& f) {
  size_t i = 0;
  for (; i + kLanes <= total; i += kLanes) f(i, size_t{kLanes});
  if (i < total) f(i, total - i);
}

// e^x, clamped to the range of floats.
SP_INLINE F16 exponential(const F16& x) {
  return exp2(clamp(x * F16(1.44269504089f), F16(-126.0f), F16(127.0f)));
}

static void shapes(const ShapeInput& in) {
  each_pack(3 * in.n, [&](size_t i, size_t count) {
    float smallest[kLanes] = {};
    for (size_t k = 0; k < count; ++k) smallest[k] = in.smallest[(i + k) / 3];
    const F16 floor = load(smallest);
    const F16 twice = F16(2.0f) * load_first(in.log_scales + i, count);
    store_first(in.scales + i, sqrt(exponential(twice) + floor * floor), count);
  });
  each_pack(in.n, [&](size_t i, size_t count) {
    const F16 e = exponential(-load_first(in.logit_opacities + i, count));
    store_first(in.opacities + i, F16(1.0f) / (F16(1.0f) + e), count);
  });
}

static void shapes_backward(const ShapeGradientInput& in) {
  each_pack(3 * in.n, [&](size_t i, size_t count) {
    float smallest[kLanes] = {};
    for (size_t k = 0; k < count; ++k) smallest[k] = in.smallest[(i + k) / 3];
    const F16 floor = load(smallest), v = load_first(in.v_scales + i, count);
    const F16 scale = max(load_first(in.scales + i, count), F16(1.2e-38f));
    store_first(in.v_log_scales + i, v * (scale - floor * floor / scale), count);
  });
  each_pack(in.n, [&](size_t i, size_t count) {
    const F16 o = load_first(in.opacities + i, count);
    const F16 v = load_first(in.v_opacities + i, count);
    store_first(in.v_logit_opacities + i, v * o * (F16(1.0f) - o), count);
  });
}

extern const LossKernels kLossKernels;
const LossKernels kLossKernels = {photometric_scratch, photometric, log_depth, shapes,
                                  shapes_backward};

}  // namespace splatpilot::SIMD_LEVEL
