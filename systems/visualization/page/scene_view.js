// A scene in a Meshcat page: hidden parts, distances at a height, cameras of the capture, and a
// ruler.
//
// Keys: 1 shows the scene from above; r, f, b and u switch the ruler, the distances, Gaussians
// beyond the bounds and the plain surfaces in front of unobserved space.
"use strict";

class SceneView {
  static async open(viewer, splats, data) {
    const values = data.grid && new Uint8Array(await inflate(data.grid.values));
    return new SceneView(viewer, splats, data, values);
  }

  constructor(viewer, splats, data, values) {
    Object.assign(this, {viewer, splats, data});
    this.pose = null;  // from which the view looks; null where the mouse decides
    this.ruler = new Ruler(viewer, data.unit);
    if (data.cameras) this.cameras = new CaptureCameras(viewer, data.cameras);
    if (values) {
      this.slice = new DistanceSlice(data.grid, values);
      viewer.scene.add(this.slice.mesh);
    }
    const size = Math.hypot(...data.upper.map((x, axis) => x - data.lower[axis]));
    viewer.camera.far = Math.max(1000, 20 * size);
    viewer.controls.maxPolarAngle = 0.5 * Math.PI;  // above ground
    this.switches = {};
    this.build();
    this.setHeight(data.height);
    this.choose(null);
    this.look();
    viewer.render_callback = () => {
      if (this.pose) placeCamera(viewer, this.pose.clone());
      this.ruler.moveLabel();
    };
    // Meshcat's controls have the pointer's events end here, not at the canvas.
    const pane = viewer.dom_element;
    pane.addEventListener("pointerdown", (event) => {
      this.pressed = event;
      if (!this.ruling) this.leavePose();
    });
    pane.addEventListener("wheel", () => this.leavePose());
    pane.addEventListener("pointerup", (event) => {
      const moved = Math.hypot(event.clientX - this.pressed?.clientX,
        event.clientY - this.pressed?.clientY);
      if (event.button === 0 && moved < 4) this.click(event.clientX, event.clientY);
    });
    pane.addEventListener("dblclick", (event) => {
      const point = !this.ruling && this.surfaceAt(event.clientX, event.clientY);
      if (point) this.turnAbout(new THREE.Vector3(...point));
    });
  }

  build() {
    const {data} = this;
    const panel = addPanel("view-panel", data.name);
    addElement(panel, "div", {textContent: data.size, id: "view-size"});
    for (const note of data.notes) addElement(panel, "div", {className: "part", textContent: note});
    const legend = addElement(panel, "div", {className: "legend"});
    for (const [color, text] of data.legend) {
      addElement(legend, "span", {className: "mark"}).style.background = color;
      legend.append(`${text} `);
    }
    if (this.slice) {
      addElement(panel, "div", {className: "part", textContent: "distance to the nearest surface:"});
      const {colors, texts} = this.slice.legend(data.unit);
      addScale(panel, "view-legend", colors, texts);
    }
    if (this.cameras) {
      const row = addElement(panel, "div", {className: "part"});
      const step = (by) => {
        const {chosen, poses} = this.cameras;
        this.choose(chosen === null ? 0 : (chosen + by + poses.length) % poses.length);
      };
      addElement(row, "button", {textContent: "◀", onclick: () => step(-1)});
      row.append(" ");
      addElement(row, "button", {textContent: "▶", id: "view-next", onclick: () => step(1)});
      row.append(" ");
      this.lookButton = addElement(row, "button", {
        textContent: "look from there", id: "view-look", onclick: () => this.lookFromCamera()});
      this.caption = addElement(row, "span");
      this.image = addElement(panel, "img", {id: "view-image"});
    }
    this.result = addElement(panel, "div", {className: "part", id: "view-result"});

    const bar = addElement(document.body, "div", {id: "view-bar", className: "bar"});
    addElement(bar, "button", {textContent: "from above (1)", onclick: () => this.look()});
    bindKeys({1: () => this.look()});
    const toggle = (key, name, ...rest) => {
      this.switches[name] = addSwitch(bar, key, `view-${name}`, ...rest);
    };
    toggle("r", "ruler", "ruler", false, (on) => this.rule(on));
    if (this.slice) {
      toggle("f", "slice", "distances here", false, (on) => { this.slice.mesh.visible = on; });
    }
    toggle("b", "beyond", "beyond bounds", data.beyond, (on) => this.splats.bound(
      on ? [-1e9, -1e9, -1e9] : data.lower, on ? [1e9, 1e9] : data.upper));
    if (data.unknown > 0) {
      this.switches.unknown = addNeverSeen(bar, "view-unknown", this.splats, data.unknown);
    }
    this.slider = addHeightSlider(
      bar, "view-height", data.lower[2], data.upper[2], (z) => this.setHeight(z));
    this.heightText = addElement(bar, "span");
  }

  setHeight(z) {
    this.height = z;
    this.slider.value = z;
    // At the upper end nothing is hidden: Gaussians may reach beyond the bounds.
    const all = z >= this.data.upper[2] - 1e-3;
    this.splats.cut = all ? Infinity : z;
    this.heightText.textContent = `${z.toFixed(2)} ${this.data.unit}`;
    if (this.slice) this.slice.height = z;
    this.viewer.set_dirty();
  }

  choose(k) {
    if (!this.cameras) return;
    this.cameras.choose(k);
    this.image.hidden = this.lookButton.hidden = k === null;
    this.caption.textContent = k === null ? " captured images; or click on one" : ` ${this.cameras.names[k]}`;
    if (k !== null) this.image.src = this.cameras.source(k);
  }

  rule(ruling) {
    this.ruling = ruling;
    this.viewer.dom_element.style.cursor = ruling ? "crosshair" : "";
    if (!ruling) this.ruler.set([]);
    this.tell();
  }

  // The length on the ruler, and the command that uses it.
  tell(missed = false) {
    const {points, length} = this.ruler, {unit, scale_command} = this.data;
    const text = (p) => p.map((value) => value.toFixed(3)).join(",");
    this.result.replaceChildren();
    if (!this.ruling) return;
    this.result.append(missed ? "No surface is there; click on one."
      : points.length === 0 ? "Click on two points."
      : points.length === 1 ? `From ${text(points[0])}; click on another point.`
      : `${length.toFixed(3)} ${unit} from ${text(points[0])} to ${text(points[1])}`);
    if (points.length === 2 && scale_command) {
      const command = document.createElement("code");
      command.textContent = `${scale_command} --between "${text(points[0])}" `
        + `"${text(points[1])}" --distance METERS`;
      this.result.append(document.createElement("br"), "With the true length, in a shell:", command);
    }
  }

  click(x, y) {
    if (this.ruling) {
      const point = this.surfaceAt(x, y);
      if (point) this.ruler.add(point);
      this.tell(!point);
    } else if (this.cameras?.group.visible) {
      this.choose(this.cameras.at(x, y));
    }
  }

  // The point of W on the surface seen at x, y in the window [px], or null.
  surfaceAt(x, y) {
    const {camera, scene} = this.viewer;
    const eye = scene.worldToLocal(new THREE.Vector3().setFromMatrixPosition(camera.matrixWorld));
    const toward = (u, v) => scene.worldToLocal(new THREE.Vector3(u, v, 0.5).unproject(camera))
      .sub(eye).normalize().toArray();
    const ray = toward(2 * x / window.innerWidth - 1, 1 - 2 * y / window.innerHeight);
    const ahead = scene.worldToLocal(camera.localToWorld(new THREE.Vector3(0, 0, -1))).sub(eye);
    return surfaceAlong(this.splats, eye.toArray(), ray, ahead.normalize().toArray());
  }

  // The whole scene from above, as near as it fits into the window.
  look() {
    const {lower, upper} = this.data, {camera, scene} = this.viewer;
    const toward = new THREE.Vector3(...this.data.toward).normalize();
    const target = new THREE.Vector3(...lower).lerp(new THREE.Vector3(...upper), 0.5)
      .setZ(Math.min(this.height, upper[2]));
    this.leavePose();
    camera.fov = 60;
    // The middle of the view is that of what the panel leaves of the window, if that is wide.
    const {innerWidth: width, innerHeight: height} = window, panel = width > 800 ? 348 : 0;
    camera.setViewOffset(width, height, -panel / 2, 0, width, height);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => new THREE.Vector3(
      ...[0, 1, 2].map((axis) => (k >> axis & 1 ? upper : lower)[axis])));
    const left = 2 * panel / width - 0.97;
    const fits = (p) => p.x > left && p.x < 0.97 && p.y > -0.8 && p.y < 0.95 && p.z < 1;
    for (let distance = 0.5 * target.distanceTo(corners[0]); ; distance *= 1.05) {
      const eye = target.clone().addScaledVector(toward, distance);
      placeCamera(this.viewer, lookAt(eye, target));
      camera.updateMatrixWorld();
      if (corners.every((p) => fits(scene.localToWorld(p.clone()).project(camera)))) break;
    }
    this.turnAbout(target);
  }

  // Through the camera of the chosen image; the mouse leads away from there.
  lookFromCamera() {
    const {poses, chosen, fov_y} = this.cameras;
    this.pose = poses[chosen].clone().multiply(new THREE.Matrix4().makeScale(1, -1, -1));
    this.viewer.controls.enabled = false;
    this.viewer.camera.fov = fov_y;
    this.viewer.camera.clearViewOffset();
    this.setHeight(this.data.upper[2]);
    this.switches.beyond(true);
    this.switches.unknown?.(true);
    this.showDrawn(false);
  }

  leavePose() {
    if (!this.pose) return;
    const ahead = new THREE.Vector3(0, 0, -1).applyMatrix4(this.pose);
    this.pose = null;
    this.viewer.controls.enabled = true;
    this.showDrawn(true);
    this.turnAbout(ahead);
  }

  // Shows or hides bounds, start, goal and frusta.
  showDrawn(shown) {
    this.viewer.scene_tree.find(["splatpilot"]).object.visible = shown;
    this.cameras.group.visible = shown;
    this.viewer.set_dirty();
  }

  // Turning the mouse turns the view about this point of W.
  turnAbout(point) {
    const {camera, controls, scene} = this.viewer;
    controls.target.copy(camera.parent.worldToLocal(scene.localToWorld(point.clone())));
    this.viewer.set_dirty();
  }
}
