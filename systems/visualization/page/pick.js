// Where a ray meets the surfaces that Gaussians show: as the depth of the onboard camera, the point
// of greatest density along the ray at the Gaussian where what passes falls to one half.
"use strict";

// The floats whose halves are 0 to 65535.
const halves = Float32Array.from({length: 1 << 16}, (_, bits) => THREE.DataUtils.fromHalfFloat(bits));

// Whether the shader leaves out a Gaussian with this mean and these variances.
function beyond([x, y, z], [xx, yy, zz], lower, upper) {
  const a = Math.sqrt(xx), b = Math.sqrt(yy);
  return x - a < lower.x || y - b < lower.y || z - Math.sqrt(zz) < lower.z
    || x + a > upper.x || y + b > upper.y || z > upper.z;
}

// The point where the ray from `o` along the unit vector `u` meets a surface, or null; W, arrays of
// three. `forward` is the direction in which depth is ordered.
function surfaceAlong(splats, o, u, forward) {
  const {packed, floats} = splats, {lower, upper, shown} = splats.mesh.material.uniforms;
  const hits = [];
  for (let i = 0; i < 8 * shown.value; i += 8) {
    const x = floats[i] - o[0], y = floats[i + 1] - o[1], z = floats[i + 2] - o[2];
    const depth = x * forward[0] + y * forward[1] + z * forward[2];
    if (depth < 0.05) continue;
    const [p, q, r] = [packed[i + 4], packed[i + 5], packed[i + 6]];
    let xx = halves[p & 65535] / 256, yy = halves[q >>> 16] / 256, zz = halves[r >>> 16] / 256;
    if (beyond(floats.subarray(i, i + 3), [xx, yy, zz], lower.value, upper.value)) continue;
    const trace = xx + yy + zz, along = x * u[0] + y * u[1] + z * u[2];
    const opacity = (packed[i + 3] >>> 24) / 255;
    const reach = 2 * Math.log(255 * opacity) * trace;
    if (x * x + y * y + z * z - along * along > reach) continue;
    // Halves have ten bits: a flat Gaussian gets a thickness that they can tell from none.
    const floor = 1e-3 * trace;
    xx += floor;
    yy += floor;
    zz += floor;
    const xy = halves[p >>> 16] / 256, xz = halves[q & 65535] / 256, yz = halves[r & 65535] / 256;
    const a = yy * zz - yz * yz, b = xz * yz - xy * zz, c = xy * yz - xz * yy;
    const d = xx * zz - xz * xz, e = xy * xz - xx * yz, f = xx * yy - xy * xy;
    const determinant = xx * a + xy * b + xz * c;
    const form = (s, t) => (s[0] * (a * t[0] + b * t[1] + c * t[2])
      + s[1] * (b * t[0] + d * t[1] + e * t[2])
      + s[2] * (c * t[0] + e * t[1] + f * t[2])) / determinant;
    const m = [x, y, z], uu = form(u, u), t = form(u, m) / uu;
    const alpha = Math.min(opacity * Math.exp(-0.5 * (form(m, m) - t * t * uu)), 0.99);
    if (alpha > 1 / 255 && t > 0) hits.push({depth, t, alpha});
  }
  hits.sort((one, other) => one.depth - other.depth);
  let passing = 1;
  for (const {t, alpha} of hits) {
    passing *= 1 - alpha;
    if (passing <= 0.5) return o.map((value, k) => value + t * u[k]);
  }
  return null;
}
