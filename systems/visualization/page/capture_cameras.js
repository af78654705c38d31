// The cameras of a capture, as frusta, and the image of one.
"use strict";

class CaptureCameras {
  // `cameras`: {size, slope_x, slope_y, fov_y, poses, names, images}, see `pages.scene_page`.
  constructor(viewer, cameras) {
    Object.assign(this, cameras, {viewer});
    this.poses = cameras.poses.map((pose) => new THREE.Matrix4().fromArray(pose).transpose());
    this.group = new THREE.Group();
    this.frusta = new THREE.LineSegments(
      this.outline(this.poses), new THREE.LineBasicMaterial({color: 0xff9020}));
    this.outlined = new THREE.LineSegments(
      new THREE.BufferGeometry(), new THREE.LineBasicMaterial({color: 0x30a0ff}));
    const {size, slope_x, slope_y} = this;
    this.picture = new THREE.Mesh(
      new THREE.PlaneGeometry(2 * slope_x * size, 2 * slope_y * size),
      new THREE.MeshBasicMaterial({side: THREE.DoubleSide}));
    this.picture.matrixAutoUpdate = false;
    this.group.add(this.frusta, this.outlined, this.picture);
    for (const object of this.group.children) object.frustumCulled = false;
    viewer.scene.add(this.group);
    this.chosen = null;
    this.choose(null);
  }

  outline(poses) {
    const {size, slope_x, slope_y} = this, points = [];
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(
      ([x, y]) => new THREE.Vector3(x * slope_x * size, y * slope_y * size, size));
    for (const pose of poses) {
      const p = corners.map((corner) => corner.clone().applyMatrix4(pose));
      const center = new THREE.Vector3().setFromMatrixPosition(pose);
      p.forEach((corner, k) => points.push(center, corner, corner, p[(k + 1) % 4]));
    }
    return new THREE.BufferGeometry().setFromPoints(points);
  }

  // The camera whose frustum is on the screen at x, y in the window [px], or null.
  at(x, y) {
    let nearest = 18, found = null;
    this.poses.forEach((pose, k) => {
      const p = inWindow(new THREE.Vector3(0, 0, 0.6 * this.size).applyMatrix4(pose));
      const distance = Math.hypot(p.x - x, p.y - y);
      if (p.z < 1 && distance < nearest) [nearest, found] = [distance, k];
    });
    return found;
  }

  choose(k) {
    this.chosen = k;
    this.outlined.visible = k !== null;
    this.picture.visible = false;
    if (k !== null) {
      const {material} = this.picture;
      this.outlined.geometry = this.outline([this.poses[k]]);
      // The picture's y is up, the camera's is down.
      this.picture.matrix.copy(this.poses[k])
        .multiply(new THREE.Matrix4().makeTranslation(0, 0, this.size))
        .multiply(new THREE.Matrix4().makeRotationX(Math.PI));
      this.picture.matrixWorldNeedsUpdate = true;
      new THREE.TextureLoader().load(this.source(k), (texture) => {
        if (this.chosen !== k) return;
        texture.colorSpace = THREE.SRGBColorSpace;
        material.map?.dispose();
        material.map = texture;
        material.needsUpdate = true;
        this.picture.visible = true;
        this.viewer.set_dirty();
      });
    }
    this.viewer.set_dirty();
  }

  source(k) {
    return `data:image/jpeg;base64,${this.images[k]}`;
  }
}
