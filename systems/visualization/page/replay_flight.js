// Shows one flight, and moving spheres, at a time.
"use strict";

const lerp = (a, b, s) => a + (b - a) * s;

// One flight's samples, plans and pictures.
class ReplayFlight {
  constructor(data, k, replay) {
    Object.assign(this, data);
    this.vehicle = replay.viewer.scene_tree.find(["splatpilot", "vehicles", `${k}`]).object;
    this.vehicle.matrixAutoUpdate = false;
    this.points = data.p_WB.map((p) => new THREE.Vector3(...p));
    this.rotations = data.q_WB.map(([w, x, y, z]) => new THREE.Quaternion(x, y, z, w));
    this.duration = this.times.at(-1);
    this.lengths = [0];
    for (let i = 1; i < this.points.length; ++i) {
      this.lengths.push(this.lengths[i - 1] + this.points[i].distanceTo(this.points[i - 1]));
    }
    this.group = new THREE.Group();
    if (this.lengths.at(-1) > 0) {
      const curve = new THREE.CatmullRomCurve3(this.points), color = this.color;
      const tube = (radius) => new THREE.TubeGeometry(curve, this.points.length, radius, 5);
      this.trail = new THREE.Mesh(tube(0.015), new THREE.MeshBasicMaterial({color}));
      this.path = new THREE.Mesh(tube(0.05), new THREE.MeshBasicMaterial(
        {color, transparent: true, opacity: 0.6, depthWrite: false}));
      this.group.add(this.trail, this.path);
    }
    this.sphere = new THREE.Mesh(
      new THREE.SphereGeometry(replay.radius, 32, 16),
      new THREE.MeshBasicMaterial({transparent: true, opacity: 0.25, depthWrite: false}));
    this.group.add(this.sphere);
    if (this.plans.length) {
      this.fan = new THREE.Mesh(
        new THREE.BufferGeometry(),
        new THREE.MeshBasicMaterial({vertexColors: true, side: THREE.DoubleSide}));
      this.fan.frustumCulled = false;
      this.group.add(this.fan);
    }
  }

  // Indices of the samples around a time, and the fraction s between them.
  at(time) {
    const last = this.times.length - 1;
    let low = 0, high = last;
    while (low < high) {
      const mid = (low + high + 1) >> 1;
      if (this.times[mid] <= time) low = mid; else high = mid - 1;
    }
    const i = Math.min(low, Math.max(last - 1, 0)), j = Math.min(i + 1, last);
    const span = this.times[j] - this.times[i];
    return {i, j, s: span > 0 ? Math.min(Math.max((time - this.times[i]) / span, 0), 1) : 0};
  }

  position(time) {
    const {i, j, s} = this.at(time);
    return this.points[i].clone().lerp(this.points[j], s);
  }

  // The position after a length [m] of the path.
  positionAt(length) {
    const after = this.lengths.findIndex((l) => l >= length), i = Math.max(after - 1, 0);
    const span = this.lengths[after] - this.lengths[i];
    const s = span > 0 ? Math.max((length - this.lengths[i]) / span, 0) : 0;
    return this.points[i].clone().lerp(this.points[after], s);
  }

  pose(time) {
    const {i, j, s} = this.at(time), rotation = this.rotations[i].clone();
    return new THREE.Matrix4().makeRotationFromQuaternion(rotation.slerp(this.rotations[j], s))
      .setPosition(this.position(time));
  }

  value(name, time) {
    const {i, j, s} = this.at(time), a = this[name][i], b = this[name][j];
    return a === null || b === null ? null : lerp(a, b, s);
  }

  show(time, replay) {
    const pose = this.pose(time), {i, j, s} = this.at(time);
    this.vehicle.matrix.copy(pose);
    this.vehicle.matrixWorldNeedsUpdate = true;
    this.sphere.position.setFromMatrixPosition(pose);
    const clearance = this.value("clearances", time);
    const safe = clearance !== null && clearance >= replay.margin;
    this.sphere.material.color.set(safe ? 0x30c060 : 0xff2020);
    this.sphere.material.opacity = safe ? 0.18 : 0.45;
    if (this.trail) {
      const flown = lerp(this.lengths[i], this.lengths[j], s) / this.lengths.at(-1);
      const count = this.trail.geometry.index.count;
      this.trail.geometry.setDrawRange(0, 30 * Math.round(flown * count / 30));
    }
    if (this.fan) {
      const index = this.plans.findLastIndex((plan) => plan.time <= time + 1e-6);
      this.showPlan(index, this.points[i], replay.view === "onboard" ? 0.6 : 0);
    }
  }

  // All hypotheses of a plan as one mesh of level ribbons, from green (lowest cost) to red (highest),
  // except for parts nearer than `nearest` [m] to `eye` and would cover the view.
  showPlan(index, eye, nearest) {
    this.fan.visible = index >= 0 && this.chosen;
    if (index < 0 || (index === this.shownPlan && !nearest && !this.shownNearest)) return;
    this.shownPlan = index;
    this.shownNearest = nearest;
    const {p_WB, waypoints_W, costs} = this.plans[index];
    const known = costs.filter((cost) => cost !== null);  // others are infinite
    const lowest = Math.min(...known), span = Math.max(Math.max(...known) - lowest, 1e-9);
    const positions = [], colors = [], halfWidth = 0.012;
    waypoints_W.forEach((waypoints, k) => {
      const share = costs[k] === null ? 1 : (costs[k] - lowest) / span;
      const color = new THREE.Color(Math.min(1, 2 * share), Math.min(1, 2 * (1 - share)), 0.1)
        .convertSRGBToLinear();
      let a = p_WB;
      for (const b of waypoints) {
        if (eye.distanceTo(new THREE.Vector3(...a)) < nearest) {
          a = b;
          continue;
        }
        const dx = b[0] - a[0], dy = b[1] - a[1];
        const scale = halfWidth / Math.max(Math.hypot(dx, dy), 1e-6);
        const x = -dy * scale, y = dx * scale;
        const corners = [
          [a[0] - x, a[1] - y, a[2]], [a[0] + x, a[1] + y, a[2]],
          [b[0] + x, b[1] + y, b[2]], [b[0] - x, b[1] - y, b[2]],
        ];
        for (const corner of [0, 1, 2, 0, 2, 3]) {
          positions.push(...corners[corner]);
          colors.push(color.r, color.g, color.b);
        }
        a = b;
      }
    });
    const geometry = this.fan.geometry;
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(colors, 3));
  }
}

// Moving spheres; those with centers of nulls are hidden.
class ReplaySpheres {
  constructor({period, radii, centers}) {
    Object.assign(this, {period, radii, centers});
    this.mesh = new THREE.InstancedMesh(
      new THREE.SphereGeometry(1, 24, 12), new THREE.MeshLambertMaterial({color: 0xe6bf1a}),
      radii.length);
    this.mesh.frustumCulled = false;
  }

  show(time) {
    const last = this.centers.length - 1;
    const index = Math.min(Math.floor(time / this.period), last);
    const share = Math.min(time / this.period - index, 1);
    const before = this.centers[index], after = this.centers[Math.min(index + 1, last)];
    this.radii.forEach((radius, k) => {
      const [a, b] = [before[k], after[k]];
      const seen = a[0] !== null && b[0] !== null;
      const p = seen ? a.map((value, i) => lerp(value, b[i], share)) : [0, 0, 0];
      this.mesh.setMatrixAt(k, new THREE.Matrix4().makeScale(...Array(3).fill(seen ? radius : 0))
        .setPosition(...p));
    });
    this.mesh.instanceMatrix.needsUpdate = true;
  }
}
