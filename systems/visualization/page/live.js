// Gaussians of this page, with the live drawings of Drake's Meshcat.
"use strict";

// `url`: of Meshcat's web socket. Gaussians above a height, at first `cut`, are left out; the slider
// goes from `lower` to `upper` [m].
function showLive(splats, {url, lower, upper, cut}) {
  viewer.camera.far = 1000;
  // Meshcat's points of the same Gaussians.
  viewer.set_property(["splatpilot", "scene"], "visible", false);
  // Meshcat's messages about the background do not replace the sky.
  if (document.getElementById("sky").textContent) viewer.update_background = () => {};
  const status = document.getElementById("status-message");
  const connection = new WebSocket(url);
  connection.binaryType = "arraybuffer";
  connection.onmessage = (message) => {
    // Meshcat serves files to its own page only, so the onboard camera's image is shown only there.
    const {object} = viewer.decode(message);
    if (object?.object?.type !== "_meshfile_object") handle_message(message);
  };
  connection.onclose = () => { status.style.display = "block"; };
  viewer.connection = connection;

  const bar = addElement(document.body, "div", {className: "bar"});
  const slider = addHeightSlider(bar, "live-cut", lower, upper, (z) => {
    splats.cut = z;
    viewer.set_dirty();
  });
  slider.value = cut;
  slider.oninput();
}
