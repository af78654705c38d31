// A flight, or several through one world, in a Meshcat page: vehicle, trail, plans, camera images,
// speed and clearance, all at the time of one slider.
//
// Keys: space plays and pauses, arrows step, l loops, 1 2 3 choose the view, d switches color and
// depth, u the plain surfaces in front of unobserved space.
"use strict";

class Replay {
  constructor(viewer, splats, data) {
    Object.assign(this, data, {viewer, splats, speed: 1, pictures: new Map()});
    this.playing = this.depth = this.looping = false;
    this.flights = data.flights.map((flight, k) => new ReplayFlight(flight, k, this));
    this.duration = Math.max(...this.flights.map((flight) => flight.duration));
    this.X_BC = new THREE.Matrix4().fromArray(data.X_BC).transpose();
    for (const flight of this.flights) viewer.scene.add(flight.group);
    this.spheres = data.spheres && new ReplaySpheres(data.spheres);
    if (this.spheres) viewer.scene.add(this.spheres.mesh);
    this.build();
    this.choose(this.flights[0]);
    this.look("overview");
    this.setCut(data.cut);
    const ended = this.flights[0].outcome === "collision" ? this.flights[0].duration : 0;
    this.seek(Math.max(ended - 2, 0));
    let before = performance.now();
    const tick = (now) => {
      if (this.playing) this.seek(this.time + this.speed * (now - before) / 1000);
      before = now;
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  build() {
    const panel = addPanel("replay-panel", this.name);
    for (const flight of this.flights) {
      flight.button = addElement(panel, "button", {
        className: "flight", onclick: () => this.choose(flight)});
      flight.button.innerHTML = `<span class="mark" style="background:${flight.color}"></span>`;
      flight.button.append(`${flight.name}: ${flight.outcome}, ${flight.duration.toFixed(1)} s`);
    }
    this.picture = addElement(panel, "canvas", {width: 648, height: 486, id: "replay-picture"});
    const {colors, texts} = this.depth_scale;
    this.scale = addScale(panel, "replay-scale", colors, texts);
    this.depthButton = addElement(panel, "button", {
      textContent: "color / depth (d)", id: "replay-depth", onclick: () => this.switchDepth()});
    this.plots = [
      {name: "speeds", title: "speed [m/s]", margin: null},
      {name: "clearances", title: `clearance [m], red below ${this.margin}`, margin: this.margin},
    ].map((options) => new Plot(panel, `replay-${options.name}`, options, this));
    addElement(panel, "div", {className: "legend", innerHTML: `
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
    const speeds = addElement(bar, "select", {id: "replay-speed", title: "playback speed"});
    for (const speed of [0.1, 0.25, 0.5, 1, 2, 4]) {
      addElement(speeds, "option", {value: speed, textContent: `${speed}×`, selected: speed === 1});
    }
    speeds.onchange = () => { this.speed = Number(speeds.value); };
    addSwitch(bar, "l", "replay-loop", "loop", false, (on) => { this.looping = on; });
    const poses = {chase: () => this.chasePose(), onboard: () => this.onboardPose()};
    this.views = new Views(this.viewer, bar, "replay", poses, this.fov_y, (name) => {
      this.splats.cut = name === "overview" ? this.cut : Infinity;
      this.setNeverSeen?.(name !== "overview");
      this.hideOwn();
      this.seek(this.time ?? 0);
    });
    if (this.unknown) {
      this.setNeverSeen = addNeverSeen(bar, "replay-unknown", this.splats, this.unknown);
    }
    this.cutSlider = addHeightSlider(
      bar, "replay-cut", this.lower, this.upper, (z) => this.setCut(z));
    bindKeys({
      " ": () => this.play(!this.playing),
      ArrowLeft: () => this.seek(this.time - 0.1),
      ArrowRight: () => this.seek(this.time + 0.1),
      d: () => this.switchDepth(),
    });
    this.play(false);
  }

  get view() {
    return this.views.name;
  }

  look(view) {
    this.views.look(view);
  }

  play(playing) {
    if (playing && this.time >= this.duration) this.seek(0);
    this.playing = playing;
    this.playButton.textContent = playing ? "❚❚" : "▶";
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
    if (this.playing && this.looping && time >= this.duration) time = 0;
    this.time = Math.min(Math.max(time, 0), this.duration);
    if (this.time >= this.duration && this.playing) this.play(false);
    this.slider.value = this.time;
    this.clock.textContent = `${this.time.toFixed(2)} s`;
    for (const flight of this.flights) flight.show(this.time, this);
    this.spheres?.show(this.time);
    this.drawPicture();
    for (const plot of this.plots) plot.draw();
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

  onboardPose() {
    return this.chosen.pose(this.time).multiply(this.X_BC)
      .multiply(new THREE.Matrix4().makeScale(1, -1, -1));
  }

  // It follows the vehicle along its own path, 2 m behind, so that no obstacle is between.
  chasePose() {
    const flight = this.chosen, {i, j, s} = flight.at(this.time);
    const flown = lerp(flight.lengths[i], flight.lengths[j], s);
    const p = flight.position(this.time), eye = flight.positionAt(flown - 2);
    const ahead = flight.position(this.time + 0.5).sub(eye).setZ(0);
    if (ahead.lengthSq() < 1e-6) {
      ahead.set(1, 0, 0).applyMatrix4(new THREE.Matrix4().extractRotation(flight.pose(this.time)));
    }
    eye.addScaledVector(ahead.setZ(0).normalize(), -Math.max(0.8 - flown, 0));
    eye.z += 0.5;
    return lookAt(eye, p);
  }

  drawPicture() {
    const frames = this.chosen.frames, canvas = this.picture;
    this.picture.hidden = this.depthButton.hidden = !frames;
    this.scale.hidden = !frames || !this.depth;
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
}
