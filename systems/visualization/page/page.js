// Puts the content of a page (see `pages.splat_page`) into Meshcat's viewer.
"use strict";

// The bytes of a compressed text, see `pages.compressed`.
async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// The sky is an equirectangular picture whose columns run against the azimuth.
function showSky() {
  const picture = document.getElementById("sky").textContent;
  if (!picture) return;
  new THREE.TextureLoader().load(`data:image/png;base64,${picture}`, (texture) => {
    texture.mapping = THREE.EquirectangularReflectionMapping;
    texture.colorSpace = THREE.SRGBColorSpace;
    viewer.scene.background = texture;
    viewer.set_dirty();
  });
}

// Puts the view's camera (z backwards) at a pose in W, whatever Meshcat's own controls say.
function placeCamera(viewer, pose) {
  const {camera, scene} = viewer;
  scene.updateMatrixWorld();
  pose.premultiply(scene.matrixWorld)
    .premultiply(camera.parent.matrixWorld.clone().invert())
    .decompose(camera.position, camera.quaternion, camera.scale);
}

function addElement(parent, tag, properties = {}) {
  return parent.appendChild(Object.assign(document.createElement(tag), properties));
}

// Calls a function of `keys`, by the names of keys.
function bindKeys(keys) {
  document.addEventListener("keydown", (event) => {
    if (event.target.matches?.("input[type=text], input[type=number], textarea")) return;
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
}

// Adds a panel with a title and a button that collapses it; it is closed at first on phones.
function addPanel(id, title) {
  const panel = addElement(document.body, "div", {id, className: "panel"});
  const header = addElement(panel, "header");
  addElement(header, "b", {textContent: title});
  const button = addElement(header, "button", {title: "collapse or expand"});
  const close = (closed) => {
    panel.classList.toggle("closed", closed);
    button.textContent = closed ? "+" : "–";
  };
  button.onclick = () => close(!panel.classList.contains("closed"));
  close(window.innerWidth < 600);
  return panel;
}

// Adds a slider of heights from `lower` to `upper` [m]; content above the height is hidden.
function addHeightSlider(bar, id, lower, upper, change) {
  const slider = Object.assign(document.createElement("input"), {
    type: "range", id, className: "cut", min: lower, max: upper, step: "any"});
  slider.oninput = () => change(Number(slider.value));
  bar.append("hide above", slider);
  return slider;
}

// Adds a button for a switch, with a key; returns a function that sets the switch.
function addSwitch(bar, key, id, text, start, change) {
  const button = addElement(bar, "button", {textContent: `${text} (${key})`, id});
  const set = (on) => {
    button.classList.toggle("chosen", on);
    change(on);
    viewer.set_dirty();
  };
  button.onclick = () => set(!button.classList.contains("chosen"));
  bindKeys({[key]: button.onclick});
  set(start);
  return set;
}

// Adds the switch of the last `count` Gaussians, those before unobserved space.
function addNeverSeen(bar, id, splats, count) {
  return addSwitch(bar, "u", id, "never seen", false, (on) => {
    splats.shown = splats.count - (on ? 0 : count);
  });
}

// Adds a scale of CSS colors with texts below, evenly spaced.
function addScale(panel, id, colors, texts) {
  const scale = addElement(panel, "div", {id, className: "scale"});
  addElement(scale, "div").style.background = `linear-gradient(to right, ${colors.join(", ")})`;
  const row = addElement(scale, "p");
  for (const text of texts) addElement(row, "span", {textContent: text});
  return scale;
}

// Buttons for the views: overview, by Meshcat's own controls, or by the poses in W (z backwards)
// that the functions `chase` and `onboard` return.
class Views {
  constructor(viewer, bar, id, poses, fov_y, change) {
    Object.assign(this, {viewer, poses, fov_y, change, name: "overview"});
    this.buttons = ["overview", "chase", "onboard"].map((name, k) => addElement(bar, "button", {
      textContent: `${name} (${k + 1})`, id: `${id}-${name}`, onclick: () => this.look(name)}));
    bindKeys({1: () => this.look("overview"), 2: () => this.look("chase"),
      3: () => this.look("onboard")});
    viewer.controls.maxPolarAngle = 0.5 * Math.PI;  // above ground
    viewer.render_callback = () => {
      const pose = this.poses[this.name]?.();
      if (pose) placeCamera(viewer, pose);
    };
  }

  look(name) {
    const {camera, controls} = this.viewer;
    if (name === "overview" && this.orbit) camera.position.copy(this.orbit);
    if (name !== "overview") this.orbit ??= camera.position.clone();
    else this.orbit = null;
    this.name = name;
    controls.enabled = name === "overview";
    camera.fov = name === "onboard" ? this.fov_y : 75;
    for (const button of this.buttons) {
      button.classList.toggle("chosen", button.id.endsWith(name));
    }
    this.change(name);
    this.viewer.set_dirty();
  }
}

// The point of the window [px], and its depth, at which the view shows a point of W.
function inWindow(p) {
  const {x, y, z} = viewer.scene.localToWorld(p.clone()).project(viewer.camera);
  return {x: (0.5 + 0.5 * x) * window.innerWidth, y: (0.5 - 0.5 * y) * window.innerHeight, z};
}

// The pose that looks from `eye` at `target`, both in W.
function lookAt(eye, target) {
  return new THREE.Matrix4().lookAt(eye, target, new THREE.Vector3(0, 0, 1)).setPosition(eye);
}

// Shows the Gaussians and the sky; returns the former and the page's other data.
async function openPage() {
  const unpack = (id) => inflate(document.getElementById(id).textContent);
  viewer.camera.far = 1000;
  const splats = new Splats(viewer, new Uint32Array(await unpack("gaussians")));
  viewer.scene.add(splats.mesh);
  showSky();
  return {splats, data: JSON.parse(new TextDecoder().decode(await unpack("data")))};
}
