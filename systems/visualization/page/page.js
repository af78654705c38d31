// Puts the content of a page (see `pages.splat_page`) into Meshcat's viewer.
"use strict";

// The bytes of a compressed text, see `pages.compressed`.
async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// Unpacks the compressed text of an element.
function unpack(id) {
  return inflate(document.getElementById(id).textContent);
}

// The sky is an equirectangular picture whose columns run against the azimuth.
function showSky() {
  const picture = document.getElementById("sky").textContent;
  if (!picture) return;
  const THREE = MeshCat.THREE;
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
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
}

// Adds a slider of heights from `lower` to `upper` [m]; content above the height is hidden.
function addHeightSlider(bar, id, lower, upper, change) {
  const slider = Object.assign(document.createElement("input"), {
    type: "range", id, min: lower, max: upper, step: "any"});
  slider.oninput = () => change(Number(slider.value));
  bar.append("hide above", slider);
  return slider;
}

// Shows the Gaussians and the sky; returns the former and the page's other data.
async function openPage() {
  const splats = new Splats(viewer, new Uint32Array(await unpack("gaussians")));
  viewer.scene.add(splats.mesh);
  showSky();
  return {splats, data: JSON.parse(new TextDecoder().decode(await unpack("data")))};
}
