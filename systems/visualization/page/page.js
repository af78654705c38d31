// Puts what the page holds (see `replay_page.py`) into Meshcat's viewer.
"use strict";

// The bytes that an element holds, compressed.
async function unpack(id) {
  const text = document.getElementById(id).textContent;
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
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

(async () => {
  const splats = new Splats(viewer, new Uint32Array(await unpack("gaussians")));
  viewer.scene.add(splats.mesh);
  showSky();
  const flights = JSON.parse(new TextDecoder().decode(await unpack("flights")));
  window.replay = new Replay(viewer, splats, flights);
})();
