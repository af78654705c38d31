// Gaussians of this page, with the live drawings and controls of Drake's Meshcat.
"use strict";

// `url`: of Meshcat's web socket. Gaussians above a height, at first `cut`, are left out; the slider
// goes from `lower` to `upper` [m].
function showLive(splats, {name, url, lower, upper, cut, fov_y}) {
  // Meshcat's points of the same Gaussians.
  viewer.set_property(["splatpilot", "scene"], "visible", false);
  // Meshcat's messages about the background do not replace the sky.
  if (document.getElementById("sky").textContent) viewer.update_background = () => {};
  const panel = addPanel("live-panel", name);
  const picture = addElement(panel, "img", {id: "live-picture", hidden: true});
  addElement(panel, "div", {className: "part", textContent:
    "Drag the vehicle or the goal with Ctrl and the mouse. Open Controls has the other controls."});
  const status = document.getElementById("status-message");
  const connection = new WebSocket(url);
  connection.binaryType = "arraybuffer";
  connection.onmessage = (message) => {
    const {object, property, value} = viewer.decode(message);
    if (property === "jpeg") {
      URL.revokeObjectURL(picture.src);
      picture.src = URL.createObjectURL(new Blob([jpegOf(value)], {type: "image/jpeg"}));
      picture.hidden = false;
    }
    // Meshcat serves files to its own page only.
    else if (object?.object?.type !== "_meshfile_object") {
      handle_message(message);
      if (object?.materials?.[0]?.vertexColors) viewer.scene_tree.object.traverse(unlight);
    }
  };
  connection.onclose = () => { status.style.display = "block"; };
  viewer.connection = connection;

  const bar = addElement(document.body, "div", {id: "live-bar", className: "bar"});
  const pose = (...path) => {
    const {object} = viewer.scene_tree.find(["splatpilot", "vehicle", ...path]);
    object.updateWorldMatrix(true, false);
    return viewer.scene.matrixWorld.clone().invert().multiply(object.matrixWorld);
  };
  const chase = () => {
    const X_WB = pose(), p = new THREE.Vector3().setFromMatrixPosition(X_WB);
    const ahead = new THREE.Vector3(1, 0, 0)
      .applyMatrix4(new THREE.Matrix4().extractRotation(X_WB)).setZ(0).normalize();
    const eye = p.clone().addScaledVector(ahead, -2);
    eye.z += 0.5;
    return lookAt(eye, p);
  };
  const onboard = () => pose("camera").multiply(new THREE.Matrix4().makeScale(1, -1, -1));
  let height = cut;
  const views = new Views(viewer, bar, "live", {chase, onboard}, fov_y, (view) => {
    splats.cut = view === "overview" ? height : Infinity;
    for (const own of ["vehicle", "trail", "hypotheses"]) {
      viewer.scene_tree.find(["splatpilot", own]).object.visible = view !== "onboard";
    }
  });
  const slider = addHeightSlider(bar, "live-cut", lower, upper, (z) => {
    height = z;
    views.look(views.name);
  });
  slider.value = cut;
  slider.oninput();
  return views;
}

// Shows colored meshes, such as plans and distances, in their own colors: lights darken them.
function unlight(mesh) {
  if (mesh.material?.type !== "MeshPhongMaterial" || !mesh.material.vertexColors) return;
  const {transparent, opacity, visible} = mesh.material, {color} = mesh.geometry.attributes;
  for (let i = 0; i < color.count; ++i) {
    const linear = new THREE.Color().fromBufferAttribute(color, i).convertSRGBToLinear();
    color.setXYZ(i, linear.r, linear.g, linear.b);
  }
  mesh.material = new THREE.MeshBasicMaterial(
    {vertexColors: true, side: THREE.DoubleSide, transparent, opacity, visible});
}

// The bytes of a picture, six in each number, the lowest first; the first number is their count.
function jpegOf([count, ...numbers]) {
  const bytes = new Uint8Array(6 * numbers.length);
  numbers.forEach((number, i) => {
    for (let k = 0; k < 6; ++k) {
      bytes[6 * i + k] = number % 256;
      number = Math.floor(number / 256);
    }
  });
  return bytes.subarray(0, count);
}
