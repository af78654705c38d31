// A place in a Meshcat page: what can be hidden, distances at a height, where it was captured from,
// and a ruler.
//
// Keys: r switches the ruler, f the distances, 1 shows the place from above.
"use strict";

class PlaceView {
  static async open(viewer, splats, data) {
    const values = data.grid && new Uint8Array(await inflate(data.grid.values));
    return new PlaceView(viewer, splats, data, values);
  }

  constructor(viewer, splats, data, values) {
    Object.assign(this, {viewer, splats, data});
    this.ruling = false;
    this.ruler = new Ruler(viewer, data.unit);
    if (data.cameras) this.cameras = new CaptureCameras(viewer, data.cameras);
    if (values) {
      this.slice = new DistanceSlice(data.grid, values);
      viewer.scene.add(this.slice.mesh);
    }
    viewer.camera.far = 1000;
    this.build();
    this.setHeight(data.height);
    this.showSlice(false);
    this.look();
    viewer.render_callback = () => this.ruler.place();
    const canvas = viewer.renderer.domElement;
    canvas.addEventListener("pointerdown", (event) => { this.pressed = event; });
    canvas.addEventListener("pointerup", (event) => {
      const moved = Math.hypot(event.clientX - this.pressed?.clientX,
        event.clientY - this.pressed?.clientY);
      if (event.button === 0 && moved < 4) this.click(event.clientX, event.clientY);
    });
    canvas.addEventListener("dblclick", (event) => {
      const point = !this.ruling && this.surfaceAt(event.clientX, event.clientY);
      if (point) this.turnAbout(point);
    });
  }

  build() {
    const {data} = this;
    const add = (parent, tag, properties = {}) =>
      parent.appendChild(Object.assign(document.createElement(tag), properties));
    const panel = add(document.body, "div", {id: "view-panel", className: "panel"});
    add(panel, "b", {textContent: data.name});
    add(panel, "div", {textContent: data.size, id: "view-size"});
    for (const note of data.notes) add(panel, "div", {className: "part", textContent: note});
    const legend = add(panel, "div", {className: "legend"});
    for (const [color, text] of data.legend) {
      add(legend, "span", {className: "mark"}).style.background = color;
      legend.append(`${text} `);
    }
    if (this.slice) {
      add(panel, "div", {className: "part", textContent: "distance to the nearest surface:"});
      const canvas = add(panel, "canvas", {width: 648, height: 56, id: "view-legend"});
      this.slice.drawLegend(canvas, data.unit);
    }
    if (this.cameras) {
      const row = add(panel, "div", {className: "part"});
      const step = (by) => {
        const {chosen, poses} = this.cameras;
        this.choose(chosen === null ? 0 : (chosen + by + poses.length) % poses.length);
      };
      add(row, "button", {textContent: "◀", onclick: () => step(-1)});
      row.append(" ");
      add(row, "button", {textContent: "▶", id: "view-next", onclick: () => step(1)});
      row.append(" ");
      this.lookButton = add(row, "button", {
        textContent: "look from there", id: "view-look", onclick: () => this.lookFromCamera()});
      this.caption = add(row, "span");
      this.image = add(panel, "img", {id: "view-image"});
    }
    this.result = add(panel, "div", {className: "part", id: "view-result"});

    const bar = add(document.body, "div", {id: "view-bar", className: "bar"});
    this.rulerButton = add(bar, "button", {
      textContent: "ruler (r)", id: "view-ruler", onclick: () => this.rule(!this.ruling)});
    add(bar, "button", {textContent: "from above (1)", onclick: () => this.look()});
    if (this.slice) {
      this.sliceButton = add(bar, "button", {
        textContent: "distances at this height (f)", id: "view-slice",
        onclick: () => this.showSlice(!this.slice.mesh.visible)});
    }
    add(bar, "span", {textContent: "hide above"});
    this.slider = add(bar, "input", {
      type: "range", id: "view-height", min: data.lower[2], max: data.upper[2], step: "any"});
    this.slider.oninput = () => this.setHeight(Number(this.slider.value));
    this.heightText = add(bar, "span");
    document.addEventListener("keydown", (event) => {
      const keys = {
        r: () => this.rule(!this.ruling),
        1: () => this.look(),
        f: () => this.slice && this.showSlice(!this.slice.mesh.visible),
      };
      if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
      keys[event.key]();
    });
    this.choose(null);
    this.rule(false);
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

  showSlice(shown) {
    if (!this.slice) return;
    this.slice.mesh.visible = shown;
    this.sliceButton.classList.toggle("chosen", shown);
    this.viewer.set_dirty();
  }

  choose(k) {
    if (!this.cameras) return;
    this.cameras.choose(k);
    this.image.hidden = this.lookButton.hidden = k === null;
    this.caption.textContent = k === null ? " captured images" : ` ${this.cameras.names[k]}`;
    if (k !== null) this.image.src = this.cameras.source(k);
  }

  rule(ruling) {
    this.ruling = ruling;
    this.rulerButton.classList.toggle("chosen", ruling);
    this.viewer.renderer.domElement.style.cursor = ruling ? "crosshair" : "";
    if (!ruling) this.ruler.set([]);
    this.tell();
  }

  // What the ruler says, and what to do with it.
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
        + `"${text(points[1])}" --distance METRES`;
      this.result.append(document.createElement("br"), "With the true length, in a shell:", command);
    }
  }

  click(x, y) {
    if (this.ruling) {
      const point = this.surfaceAt(x, y);
      if (point) this.ruler.add(point);
      this.tell(!point);
    } else if (this.cameras) {
      this.choose(this.cameras.at(x, y));
    }
  }

  // The point of W on the surface seen at x, y in the window [px], or null.
  surfaceAt(x, y) {
    const THREE = MeshCat.THREE, {camera, scene} = this.viewer;
    const eye = scene.worldToLocal(new THREE.Vector3().setFromMatrixPosition(camera.matrixWorld));
    const toward = (u, v) => scene.worldToLocal(new THREE.Vector3(u, v, 0.5).unproject(camera))
      .sub(eye).normalize().toArray();
    const ray = toward(2 * x / window.innerWidth - 1, 1 - 2 * y / window.innerHeight);
    return surfaceAlong(
      this.splats.packed, eye.toArray(), ray, toward(0, 0), this.splats.cut);
  }

  // Puts the view's camera at `eye`, turned to `target`, about which the mouse turns it; both in W.
  place(eye, target) {
    const {camera, controls, scene} = this.viewer;
    scene.updateMatrixWorld();
    const local = (p) => camera.parent.worldToLocal(scene.localToWorld(p));
    camera.position.copy(local(eye));
    controls.target.copy(local(target));
    this.viewer.set_dirty();
  }

  look() {
    const THREE = MeshCat.THREE;
    this.viewer.camera.fov = 60;
    this.place(new THREE.Vector3(...this.data.eye), new THREE.Vector3(...this.data.target));
  }

  lookFromCamera() {
    const THREE = MeshCat.THREE, {poses, chosen, size, fov_y} = this.cameras;
    const at = (z) => new THREE.Vector3(0, 0, z).applyMatrix4(poses[chosen]);
    this.viewer.camera.fov = fov_y;
    this.setHeight(this.data.upper[2]);
    // From just before the picture in its frustum.
    this.place(at(1.05 * size), at(4 * size));
  }

  turnAbout(point) {
    const {camera, controls, scene} = this.viewer;
    const target = new MeshCat.THREE.Vector3(...point);
    controls.target.copy(camera.parent.worldToLocal(scene.localToWorld(target)));
    this.viewer.set_dirty();
  }
}
