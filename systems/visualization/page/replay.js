// A flight, or several through one world, in a Meshcat page: vehicle, trail, plans, camera images,
// speed and clearance, all at the time of one slider.
//
// Keys: space plays and pauses, arrows step, 1 2 3 choose the view, d switches color and depth.
"use strict";

class Replay {
  constructor(viewer, splats, data) {
    const THREE = MeshCat.THREE;
    Object.assign(this, data);
    this.viewer = viewer;
    this.splats = splats;
    this.flights = data.flights.map((flight, k) => new ReplayFlight(flight, k, this));
    this.duration = Math.max(...this.flights.map((flight) => flight.duration));
    this.X_BC = new THREE.Matrix4().fromArray(data.X_BC).transpose();
    this.playing = false;
    this.depth = false;
    this.pictures = new Map();
    for (const flight of this.flights) viewer.scene.add(flight.group);
    this.spheres = data.spheres && new ReplaySpheres(data.spheres);
    if (this.spheres) viewer.scene.add(this.spheres.mesh);
    this.build();
    this.choose(this.flights[0]);
    this.look("overview");
    this.setCut(data.cut);
    viewer.render_callback = () => this.placeCamera();
    const ended = this.flights[0].outcome === "collision" ? this.flights[0].duration : 0;
    this.seek(Math.max(ended - 2, 0));
    let before = performance.now();
    const tick = (now) => {
      if (this.playing) this.seek(this.time + (now - before) / 1000);
      before = now;
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  build() {
    const panel = addElement(document.body, "div", {id: "replay-panel", className: "panel"});
    for (const flight of this.flights) {
      flight.button = addElement(panel, "button", {
        className: "flight", onclick: () => this.choose(flight)});
      flight.button.innerHTML = `<span class="mark" style="background:${flight.color}"></span>`;
      flight.button.append(`${flight.name}: ${flight.outcome}, ${flight.duration.toFixed(1)} s`);
    }
    this.picture = addElement(panel, "canvas", {width: 648, height: 486, id: "replay-picture"});
    this.depthButton = addElement(panel, "button", {
      textContent: "color / depth (d)", id: "replay-depth", onclick: () => this.switchDepth()});
    this.plot = addElement(panel, "canvas", {width: 648, height: 300, id: "replay-plot"});
    this.plot.onclick = (event) =>
      this.seek(event.offsetX / this.plot.clientWidth * this.duration);
    addElement(panel, "div", {className: "legend", innerHTML: `
      <span class="mark" style="background:#6fb7ff"></span>speed
      <span class="mark" style="background:#ffc04d"></span>clearance, red below
      ${this.margin} m<br>
      <span class="mark" style="background:#1aff1a"></span>plan of lowest cost
      <span class="mark" style="background:#ff1a1a"></span>highest cost
      <span class="mark" style="background:#1ae64d"></span>goal`});

    const bar = addElement(document.body, "div", {id: "replay-bar", className: "bar"});
    this.playButton = addElement(bar, "button", {onclick: () => this.play(!this.playing)});
    this.slider = addElement(bar, "input", {
      type: "range", min: 0, max: this.duration, step: 0.01, id: "replay-time"});
    this.slider.oninput = () => {
      this.play(false);
      this.seek(Number(this.slider.value));
    };
    this.clock = addElement(bar, "span");
    this.viewButtons = ["overview", "chase", "onboard"].map((name, k) => addElement(bar, "button", {
      textContent: `${name} (${k + 1})`, id: `replay-${name}`, onclick: () => this.look(name)}));
    this.cutSlider = addHeightSlider(
      bar, "replay-cut", this.lower, this.upper, (z) => this.setCut(z));
    bindKeys({
      " ": () => this.play(!this.playing),
      ArrowLeft: () => this.seek(this.time - 0.1),
      ArrowRight: () => this.seek(this.time + 0.1),
      1: () => this.look("overview"),
      2: () => this.look("chase"),
      3: () => this.look("onboard"),
      d: () => this.switchDepth(),
    });
    this.play(false);
  }

  play(playing) {
    if (playing && this.time >= this.duration) this.seek(0);
    this.playing = playing;
    this.playButton.textContent = playing ? "❚❚" : "▶";
  }

  look(view) {
    this.view = view;
    ["overview", "chase", "onboard"].forEach((name, k) =>
      this.viewButtons[k].classList.toggle("chosen", name === view));
    this.viewer.controls.enabled = view === "overview";
    if (view === "overview" && this.orbit) {
      this.viewer.camera.position.copy(this.orbit);
    } else if (view !== "overview") {
      this.orbit ??= this.viewer.camera.position.clone();
    }
    this.viewer.camera.fov = view === "onboard" ? this.fov_y : 75;
    this.splats.cut = view === "overview" ? this.cut : Infinity;
    this.hideOwn();
    this.seek(this.time ?? 0);
  }

  setCut(height) {
    this.cut = height;
    this.cutSlider.value = height;
    if (this.view === "overview") this.splats.cut = height;
    this.viewer.set_dirty();
  }

  choose(chosen) {
    for (const flight of this.flights) {
      flight.chosen = flight === chosen;
      flight.button.classList.toggle("chosen", flight.chosen);
    }
    this.chosen = chosen;
    this.hideOwn();
    this.seek(this.time ?? 0);
  }

  switchDepth() {
    this.depth = !this.depth;
    this.drawPicture();
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    if (this.time >= this.duration && this.playing) this.play(false);
    this.slider.value = this.time;
    this.clock.textContent = `${this.time.toFixed(2)} s`;
    for (const flight of this.flights) flight.show(this.time, this);
    this.spheres?.show(this.time);
    this.drawPicture();
    this.drawPlot();
    this.viewer.set_dirty();
  }

  // The onboard view shows neither the vehicle nor its trail; only the overview the path ahead.
  hideOwn() {
    for (const flight of this.flights) {
      const seen = !(this.view === "onboard" && flight.chosen);
      flight.vehicle.visible = flight.sphere.visible = seen;
      if (flight.trail) {
        flight.trail.visible = seen;
        flight.path.visible = this.view === "overview";
      }
    }
  }

  // The view's pose in W, z backwards; null where Meshcat's own controls decide.
  cameraPose() {
    const THREE = MeshCat.THREE, flight = this.chosen;
    if (this.view === "overview") return null;
    if (this.view === "onboard") {
      return flight.pose(this.time).multiply(this.X_BC)
        .multiply(new THREE.Matrix4().makeScale(1, -1, -1));
    }
    // It follows the vehicle along its own path, a second behind, so that no obstacle is between.
    const p = flight.position(this.time), eye = flight.position(this.time - 1.0);
    const ahead = flight.position(this.time + 0.5).sub(eye).setZ(0);
    if (ahead.lengthSq() < 1e-6) {
      ahead.set(1, 0, 0).applyMatrix4(new THREE.Matrix4().extractRotation(flight.pose(this.time)));
    }
    const distance = p.clone().sub(eye).length();
    eye.addScaledVector(ahead.setZ(0).normalize(), -Math.max(2 - distance, 0));
    eye.z += 0.5;
    const pose = new THREE.Matrix4().lookAt(eye, p, new THREE.Vector3(0, 0, 1));
    return pose.setPosition(eye);
  }

  placeCamera() {
    const pose = this.cameraPose();
    if (pose) placeCamera(this.viewer, pose);
  }

  drawPicture() {
    const frames = this.chosen.frames, canvas = this.picture;
    this.picture.hidden = this.depthButton.hidden = !frames;
    if (!frames) return;
    const row = this.depth ? frames.depth : frames.color;
    const index = Math.min(Math.floor(this.time / frames.period + 1e-6), row.length - 1);
    const key = `${this.flights.indexOf(this.chosen)} ${this.depth} ${index}`;
    if (!this.pictures.has(key)) {
      const image = new Image();
      image.onload = () => this.drawPicture();
      image.src = `data:image/jpeg;base64,${row[index]}`;
      if (this.pictures.size > 60) this.pictures.clear();
      this.pictures.set(key, image);
    }
    const image = this.pictures.get(key);
    if (!image.complete || !image.naturalWidth) return;
    canvas.height = Math.round(canvas.width * image.naturalHeight / image.naturalWidth);
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  }

  drawPlot() {
    const canvas = this.plot, context = canvas.getContext("2d"), flight = this.chosen;
    const {width, height} = canvas;
    const known = (name) => flight[name].filter((value) => value !== null);
    const top = Math.max(1, ...known("speeds"), ...known("clearances"));
    const bottom = Math.min(0, ...known("clearances"));
    const x = (time) => time / this.duration * width;
    const y = (value) => 10 + (top - value) / (top - bottom) * (height - 40);
    context.fillStyle = "#15171b";
    context.fillRect(0, 0, width, height);
    context.font = "22px system-ui, sans-serif";
    context.fillStyle = context.strokeStyle = "#888";
    context.lineWidth = 1;
    for (let value = Math.ceil(bottom); value <= top; ++value) {
      context.beginPath();
      context.moveTo(0, y(value));
      context.lineTo(width, y(value));
      context.stroke();
      context.fillText(`${value}`, 2, y(value) - 3);
    }
    context.fillStyle = "rgba(255, 32, 32, 0.3)";
    context.fillRect(0, y(this.margin), width, y(bottom) - y(this.margin));
    for (const [name, color] of [["speeds", "#6fb7ff"], ["clearances", "#ffc04d"]]) {
      context.strokeStyle = color;
      context.lineWidth = 3;
      context.beginPath();
      flight.times.forEach((time, i) => {
        if (flight[name][i] !== null) context.lineTo(x(time), y(flight[name][i]));
      });
      context.stroke();
    }
    context.fillStyle = "#fff";
    context.fillRect(x(this.time) - 1, 0, 3, height - 28);
    const tell = (name, unit) => {
      const value = flight.value(name, this.time);
      return value === null ? "–" : `${value.toFixed(2)} ${unit}`;
    };
    context.fillText(
      `${tell("speeds", "m/s")}   clearance ${tell("clearances", "m")}`, 30, height - 6);
  }
}
