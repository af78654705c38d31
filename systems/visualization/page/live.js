// What Drake's Meshcat draws while it runs, beside the Gaussians that this page holds.
"use strict";

// `url`: of Meshcat's web socket.
function connectTo(url) {
  // There the Gaussians are points.
  viewer.set_property(["splatpilot", "scene"], "visible", false);
  // The sky stays, whatever is said of the background from now on.
  if (document.getElementById("sky").textContent) viewer.update_background = () => {};
  viewer.camera.far = 1000;
  const status = document.getElementById("status-message");
  const connection = new WebSocket(url);
  connection.binaryType = "arraybuffer";
  connection.onmessage = (message) => handle_message(message);
  connection.onclose = () => { status.style.display = "block"; };
  viewer.connection = connection;
}
