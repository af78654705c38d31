// A level cut through the grid of a distance field, as a textured plane.
"use strict";

class DistanceSlice {
  // `grid` of `pages.scene_page`, and its values: x the fastest, then y, then z; 255 in
  // unobserved space.
  constructor(grid, values) {
    const [nx, ny] = grid.shape, edge = grid.voxel_size;
    Object.assign(this, grid, {values});
    this.texture = new THREE.DataTexture(new Uint8Array(4 * nx * ny), nx, ny);
    this.texture.colorSpace = THREE.SRGBColorSpace;
    this.texture.magFilter = THREE.NearestFilter;
    this.mesh = new THREE.Mesh(
      new THREE.PlaneGeometry(nx * edge, ny * edge),
      new THREE.MeshBasicMaterial({
        map: this.texture, side: THREE.DoubleSide, transparent: true, depthWrite: false}));
    this.mesh.position.set(grid.lower[0] + nx * edge / 2, grid.lower[1] + ny * edge / 2, 0);
  }

  set height(z) {
    const [nx, ny, nz] = this.shape, size = nx * ny;
    const layer = Math.floor((z - this.lower[2]) / this.voxel_size);
    const start = size * Math.min(Math.max(layer, 0), nz - 1);
    const pixels = this.texture.image.data;
    for (let i = 0; i < size; ++i) {
      const value = this.values[start + i];
      const hatched = value === 255 && (i % nx + Math.floor(i / nx)) % 6 < 2;
      for (let k = 0; k < 3; ++k) pixels[4 * i + k] = this.palette[value][k] * (hatched ? 0.6 : 1);
      pixels[4 * i + 3] = value === 255 ? 130 : 205;
    }
    this.texture.needsUpdate = true;
    this.mesh.position.z = z;
  }

  // Colors and texts of the scale, the last of unobserved space.
  legend(unit) {
    const css = (value) => `rgb(${this.palette[value]})`;
    const colors = [0, 32, 64, 96, 127, 159, 191, 222, 254].map((value) => css(value));
    const length = (value) => `${+value.toPrecision(3)} ${unit}`;
    return {
      colors: [...colors, `${css(254)} 80%`, `${css(255)} 80%`, css(255)],
      texts: ["surface", length(this.reach / 2), `${length(this.reach)} +`, "never seen"],
    };
  }
}
