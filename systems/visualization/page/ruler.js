// Two points picked on surfaces, and the length between them.
"use strict";

class Ruler {
  // `unit`: of lengths.
  constructor(viewer, unit) {
    const color = 0xc81e5a;
    Object.assign(this, {viewer, unit, points: []});
    // Drawn over everything, so that the ends are seen from wherever one looks.
    const over = {color, depthTest: false, transparent: true};
    this.ends = new THREE.Points(
      new THREE.BufferGeometry(),
      new THREE.PointsMaterial({...over, size: 11, sizeAttenuation: false}));
    this.line = new THREE.Mesh(
      new THREE.CylinderGeometry(1, 1, 1, 8).rotateX(Math.PI / 2),
      new THREE.MeshBasicMaterial(over));
    this.group = new THREE.Group();
    this.group.add(this.ends, this.line);
    for (const object of this.group.children) {
      object.frustumCulled = false;
      object.renderOrder = 9;
    }
    this.label = addElement(document.body, "div", {id: "view-label"});
    viewer.scene.add(this.group);
    this.set([]);
  }

  // A third point begins another length.
  add(point) {
    this.set(this.points.length === 2 ? [point] : [...this.points, point]);
  }

  set(points) {
    const [a, b] = points.map((p) => new THREE.Vector3(...p));
    this.points = points;
    this.group.visible = points.length > 0;
    this.line.visible = points.length === 2;
    this.label.hidden = points.length < 2;
    this.ends.geometry.setAttribute(
      "position", new THREE.Float32BufferAttribute(points.flat(), 3));
    this.length = b ? a.distanceTo(b) : null;
    if (b) {
      this.middle = a.clone().lerp(b, 0.5);
      this.line.position.copy(this.middle);
      this.line.scale.set(0.004 * this.length, 0.004 * this.length, this.length);
      this.line.up.set(0, 0, 1);
      this.line.quaternion.setFromUnitVectors(
        new THREE.Vector3(0, 0, 1), b.clone().sub(a).normalize());
      this.label.textContent = `${this.length.toFixed(2)} ${this.unit}`;
    }
    this.viewer.set_dirty();
  }

  // Keeps the label at the middle of the line.
  moveLabel() {
    if (!this.line.visible) return;
    const {x, y, z} = inWindow(this.middle);
    this.label.hidden = z > 1;
    Object.assign(this.label.style, {left: `${x}px`, top: `${y}px`});
  }
}
