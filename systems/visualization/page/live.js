// What Drake's Meshcat draws while it runs, beside the Gaussians that this page holds.
"use strict";

// `url`: of Meshcat's web socket. Gaussians above a height, at first `cut`, are left out; the slider
// goes from `lower` to `upper` [m].
function showLive(splats, {url, lower, upper, cut}) {
  viewer.camera.far = 1000;
  // There the Gaussians are points.
  viewer.set_property(["splatpilot", "scene"], "visible", false);
  // The sky stays, whatever is said of the background from now on.
  if (document.getElementById("sky").textContent) viewer.update_background = () => {};
  const status = document.getElementById("status-message");
  const connection = new WebSocket(url);
  connection.binaryType = "arraybuffer";
  connection.onmessage = (message) => {
    // Meshcat gives files to its own page alone: what the onboard camera sees is shown only there.
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
