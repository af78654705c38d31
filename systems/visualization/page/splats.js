// Gaussians in a Meshcat page, in the same three.js scene as everything else.
//
// Each is a quad as large as its projected footprint (EWA splatting, as the onboard camera draws
// them), blended from far to near; a worker sorts them by depth whenever the view has moved. They
// are tested against the depth of opaque objects, so both hide one another.
"use strict";

class Splats {
  // `packed`: Uint32Array, 8 words each, as `pack_gaussians` writes them.
  constructor(viewer, packed) {
    Object.assign(this, {viewer, packed, count: packed.length / 8});
    this.floats = new Float32Array(packed.buffer, packed.byteOffset, packed.length);
    const rows = Math.ceil(this.count / Splats.perRow);
    const texels = new Uint32Array(rows * Splats.perRow * 8);
    texels.set(packed);
    const texture = new THREE.DataTexture(
      texels, 2 * Splats.perRow, rows, THREE.RGBAIntegerFormat, THREE.UnsignedIntType);
    texture.internalFormat = "RGBA32UI";
    texture.needsUpdate = true;

    const corners = new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]);
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    this.order = new THREE.InstancedBufferAttribute(new Uint32Array(this.count), 1);
    this.order.gpuType = THREE.IntType;
    this.order.setUsage(THREE.DynamicDrawUsage);
    geometry.setAttribute("splat", this.order);
    geometry.instanceCount = 0;
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: Splats.vertexShader,
      fragmentShader: Splats.fragmentShader,
      uniforms: {
        packed: {value: texture},
        viewport: {value: new THREE.Vector2()},
        lower: {value: new THREE.Vector3(-1e9, -1e9, -1e9)},
        upper: {value: new THREE.Vector3(1e9, 1e9, 1e9)},
        shown: {value: this.count},
      },
      transparent: true,
      depthWrite: false,
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.raycast = () => {};
    this.mesh.renderOrder = -1;  // Translucent objects are drawn over them.
    this.mesh.onBeforeRender = (renderer, scene, camera) => this.beforeRender(renderer, camera);

    const source = `(${Splats.sorter})()`;
    this.worker = new Worker(URL.createObjectURL(new Blob([source])));
    this.worker.onmessage = (event) => this.sorted(event.data);
    const centers = new Float32Array(3 * this.count);
    for (let i = 0; i < this.count; ++i) {
      centers.set(this.floats.subarray(8 * i, 8 * i + 3), 3 * i);
    }
    this.worker.postMessage({centers}, [centers.buffer]);
    this.view = null;       // by which the drawn order is sorted
    this.requested = null;  // that the worker sorts by
  }

  // Height in W above which nothing is drawn [m].
  set cut(height) {
    this.mesh.material.uniforms.upper.value.z = Math.min(height, 1e9);
  }

  // Hides Gaussians that reach beside or below a box, with corners in W.
  bound(lower, upper) {
    const {uniforms} = this.mesh.material;
    uniforms.lower.value.set(...lower);
    uniforms.upper.value.setX(upper[0]).setY(upper[1]);
  }

  // Number of drawn Gaussians, from the first.
  set shown(count) {
    this.mesh.material.uniforms.shown.value = count;
  }

  beforeRender(renderer, camera) {
    renderer.getDrawingBufferSize(this.mesh.material.uniforms.viewport.value);
    const m = this.mesh.modelViewMatrix.multiplyMatrices(
      camera.matrixWorldInverse, this.mesh.matrixWorld).elements;
    const view = [m[2], m[6], m[10], m[14]];
    this.current = view;
    if (!this.requested && !Splats.same(view, this.view)) {
      this.requested = view;
      this.worker.postMessage({view});
    }
  }

  sorted({order}) {
    this.order.array.set(order);
    this.order.clearUpdateRanges();
    this.order.addUpdateRange(0, order.length);
    this.order.needsUpdate = true;
    this.mesh.geometry.instanceCount = order.length;
    this.view = this.requested;
    this.requested = null;
    this.viewer.set_dirty();
  }

  // True if the drawn order is that of the current view.
  get settled() {
    return !this.requested && Splats.same(this.current, this.view);
  }

  static same(a, b) {
    return a && b && a.every((value, i) => Math.abs(value - b[i]) < 1e-4);
  }

  // The worker: a counting sort of Gaussians in front of the camera, farthest first.
  static sorter = () => {
    // The bits of a float grow with its logarithm: a bin is 0.02 % of the depth, from 0.05 m on.
    const nearest = 0.05, bins = 1 << 16, hidden = 1 << 17;
    const last = (new Uint32Array(new Float32Array([nearest]).buffer)[0] >>> 11) + bins - 1;
    let centers;
    self.onmessage = ({data}) => {
      if (data.centers) {
        centers = data.centers;
        return;
      }
      const [a, b, c, d] = data.view, n = centers.length / 3;
      const depths = new Float32Array(n), bits = new Uint32Array(depths.buffer);
      const starts = new Uint32Array(bins + 1), keys = bits;
      let shown = 0;
      for (let i = 0; i < n; ++i) {
        depths[i] = -(a * centers[3 * i] + b * centers[3 * i + 1] + c * centers[3 * i + 2] + d);
        keys[i] = depths[i] < nearest ? hidden : Math.max(last - (bits[i] >>> 11), 0);
        if (keys[i] !== hidden) {
          ++starts[keys[i] + 1];
          ++shown;
        }
      }
      const order = new Uint32Array(shown);
      for (let k = 0; k < bins; ++k) starts[k + 1] += starts[k];
      for (let i = 0; i < n; ++i) {
        if (keys[i] !== hidden) order[starts[keys[i]]++] = i;
      }
      self.postMessage({order}, [order.buffer]);
    };
  };
}

Splats.perRow = 1024;

Splats.vertexShader = `
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D packed;
uniform vec2 viewport;
uniform vec3 lower, upper;
uniform int shown;
uniform mat4 modelViewMatrix, projectionMatrix;
in vec3 position;
in uint splat;
out vec2 offset;  // in standard deviations
out vec4 color;

void main() {
  ivec2 texel = ivec2(2 * int(splat % ${Splats.perRow}u), int(splat / ${Splats.perRow}u));
  uvec4 a = texelFetch(packed, texel, 0), b = texelFetch(packed, texel + ivec2(1, 0), 0);
  color = vec4(a.w & 255u, (a.w >> 8) & 255u, (a.w >> 16) & 255u, a.w >> 24) / 255.0;
  vec3 mean = uintBitsToFloat(a.xyz);
  vec4 p = modelViewMatrix * vec4(mean, 1.0);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside of the view
  float z = -p.z;
  if (z < 0.05 || int(splat) >= shown) return;

  vec2 xx_xy = unpackHalf2x16(b.x), xz_yy = unpackHalf2x16(b.y), yz_zz = unpackHalf2x16(b.z);
  mat3 covariance = mat3(xx_xy.x, xx_xy.y, xz_yy.x,
                         xx_xy.y, xz_yy.y, yz_zz.x,
                         xz_yy.x, yz_zz.x, yz_zz.y) / COVARIANCE_SCALE;
  vec3 reach = sqrt(vec3(covariance[0][0], covariance[1][1], covariance[2][2]));
  if (any(lessThan(mean - reach, lower))) return;
  if (any(greaterThan(vec3(mean.xy + reach.xy, mean.z), upper))) return;
  vec2 focal = 0.5 * viewport * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  // The Jacobian is taken no farther out than a little beyond the image, as elsewhere.
  vec2 edge = 0.65 * viewport / focal * z;
  vec2 q = clamp(p.xy, -edge, edge);
  mat3 jacobian = mat3(focal.x / z, 0.0, 0.0,
                       0.0, focal.y / z, 0.0,
                       focal.x * q.x / (z * z), focal.y * q.y / (z * z), 0.0);
  mat3 m = jacobian * mat3(modelViewMatrix);
  mat3 projected = m * covariance * transpose(m);
  float u = projected[0][0] + BLUR, v = projected[1][1] + BLUR, w = projected[0][1];
  float mid = 0.5 * (u + v), radius = length(vec2(0.5 * (u - v), w));
  float large = mid + radius, small = max(mid - radius, 0.1 * BLUR);
  vec2 axis = abs(w) > 1e-6 * mid ? normalize(vec2(w, large - u))
                                  : (u >= v ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float extent = sqrt(2.0 * log(max(255.0 * color.a, 1.0)));
  offset = extent * position.xy;
  vec2 pixels = offset.x * sqrt(large) * axis + offset.y * sqrt(small) * vec2(-axis.y, axis.x);
  vec4 center = projectionMatrix * p;
  gl_Position = vec4(center.xy + 2.0 * pixels / viewport * center.w, center.zw);
}
`.replaceAll("COVARIANCE_SCALE", "256.0").replaceAll("BLUR", "0.3");

Splats.fragmentShader = `
precision highp float;
in vec2 offset;
in vec4 color;
out vec4 pixel;

void main() {
  float alpha = min(color.a * exp(-0.5 * dot(offset, offset)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(color.rgb, alpha);
}
`;
