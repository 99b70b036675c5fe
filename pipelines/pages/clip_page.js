// The page of one clip: the cursor in the curves follows the player, and the object shows the contact map of the frame.
"use strict";
(function () {
  const NEIGHBOURS = 4;
  const holder = document.getElementById("clip");
  const timeline = document.getElementById("timeline");
  const charts = JSON.parse(document.getElementById("readouts").textContent);
  const paint = JSON.parse(document.getElementById("paint-values").textContent);
  const hex = JSON.parse(document.getElementById("paint-colours").textContent);
  const nearToFarHex = JSON.parse(document.getElementById("distance-colours").textContent);
  const bits = { left: bytesOf(paint.left), right: bytesOf(paint.right) };
  const distances = Object.fromEntries(Object.entries(paint.distances).map(([side, text]) => [side, bytesOf(text)]));
  const always = { left: anyFrame(bits.left), right: anyFrame(bits.right) };
  const surfaces = [];
  let player = null, painted = null, colours = null, nearToFar = null;

  function bytesOf(text) {
    return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  }

  function linear(text) {
    return new THREE.Color(text).convertSRGBToLinear().toArray();
  }

  function anyFrame(all) {
    const union = new Uint8Array(paint.stride);
    for (let i = 0; i < all.length; i++) union[i % paint.stride] |= all[i];
    return union;
  }

  function touched(packed, point) {
    return packed[point >> 3] >> (7 - (point & 7)) & 1;
  }

  // The closest sampled points of each vertex, with Gaussian weights as wide as the point spacing.
  function surfaceOf(mesh, part) {
    const position = mesh.geometry.attributes.position, count = position.count;
    const nearest = new Uint16Array(count * NEIGHBOURS), weight = new Float32Array(count * NEIGHBOURS);
    const neighbours = Math.min(NEIGHBOURS, part.numbers.length);
    const best = new Float64Array(NEIGHBOURS), which = new Int32Array(NEIGHBOURS);
    for (let vertex = 0; vertex < count; vertex++) {
      best.fill(Infinity);
      const x = position.getX(vertex), y = position.getY(vertex), z = position.getZ(vertex);
      for (let point = 0; point < part.numbers.length; point++) {
        const dx = part.tenth_mm[3 * point] * 1e-4 - x, dy = part.tenth_mm[3 * point + 1] * 1e-4 - y, dz = part.tenth_mm[3 * point + 2] * 1e-4 - z;
        const square = dx * dx + dy * dy + dz * dz;
        let slot = neighbours;
        while (slot > 0 && square < best[slot - 1]) slot--;
        if (slot >= neighbours) continue;
        for (let later = neighbours - 1; later > slot; later--) { best[later] = best[later - 1]; which[later] = which[later - 1]; }
        best[slot] = square;
        which[slot] = point;
      }
      const width = Math.max(best[neighbours - 1], 1e-10);
      let sum = 0;
      for (let k = 0; k < neighbours; k++) sum += Math.exp(-2 * best[k] / width);
      for (let k = 0; k < neighbours; k++) {
        nearest[vertex * NEIGHBOURS + k] = part.numbers[which[k]];
        weight[vertex * NEIGHBOURS + k] = Math.exp(-2 * best[k] / width) / sum;
      }
    }
    return { mesh, nearest, weight };
  }

  // colourOf(nearest points, their weights, first of the vertex): [red, green, blue], linear.
  function repaint(colourOf) {
    for (const { mesh, nearest, weight } of surfaces) {
      const attribute = mesh.geometry.attributes.color, array = attribute.array, size = attribute.itemSize;
      const scale = array instanceof Uint8Array ? 255 : 1;
      for (let vertex = 0; vertex < attribute.count; vertex++) {
        const colour = colourOf(nearest, weight, vertex * NEIGHBOURS);
        for (let c = 0; c < 3; c++) array[vertex * size + c] = Math.round(colour[c] * scale * 1e4) / 1e4;
      }
      attribute.needsUpdate = true;
    }
    player.dirty = true;
  }

  function contactColours(left, right) {
    return (nearest, weight, first) => {
      let onLeft = 0, onRight = 0;
      for (let k = first; k < first + NEIGHBOURS; k++) {
        if (left && touched(left, nearest[k])) onLeft += weight[k];
        if (right && touched(right, nearest[k])) onRight += weight[k];
      }
      const both = Math.min(onLeft, onRight), any = Math.max(onLeft, onRight);
      const one = onLeft > onRight ? colours.left : colours.right;
      return colours.plain.map((plain, c) => plain * (1 - any) + one[c] * (any - both) + colours.both[c] * both);
    };
  }

  // steps: BimArt's distance map of one hand in one frame; larger distances get the last colour.
  function distanceColours(steps) {
    return (nearest, weight, first) => {
      let value = 0;
      for (let k = first; k < first + NEIGHBOURS; k++) value += weight[k] * Math.min(steps[nearest[k]], paint.farthest);
      const position = value / paint.farthest * (nearToFar.length - 1);
      const low = Math.min(Math.floor(position), nearToFar.length - 2);
      return nearToFar[low].map((near, c) => near + (nearToFar[low + 1][c] - near) * (position - low));
    };
  }

  function showPaint() {
    const mode = document.querySelector("input[name=paint]:checked").value;
    const frame = player.frame();
    const requested = mode === "clip" || mode === "none" ? mode : `${mode} ${frame}`;
    if (requested === painted || !surfaces.length) return;
    painted = requested;
    const rows = (all, stride) => all.subarray(frame * stride, (frame + 1) * stride);
    if (mode in distances) repaint(distanceColours(rows(distances[mode], paint.points)));
    else if (mode === "frame") repaint(contactColours(rows(bits.left, paint.stride), rows(bits.right, paint.stride)));
    else if (mode === "clip") repaint(contactColours(always.left, always.right));
    else repaint(contactColours(null, null));
    document.querySelectorAll("#paint .legend").forEach((legend) => {
      legend.hidden = (legend.dataset.for === "distance") !== (mode in distances);
    });
  }

  function showCursor() {
    const left = Number(timeline.dataset.left), right = Number(timeline.dataset.right);
    const part = Math.min(1, player.seconds / player.duration);
    timeline.querySelector(".cursor").style.left = `${left + (right - left) * part}%`;
    const box = timeline.parentElement;  // on a narrow screen the curves are wider than their box
    box.scrollLeft = timeline.offsetWidth * (left + (right - left) * part) / 100 - box.clientWidth / 2;
    timeline.querySelectorAll(".readout").forEach((readout, number) => {
      readout.querySelectorAll("b").forEach((text, line) => {
        const { values, decimals } = charts[number][line], value = values[player.frame()];
        text.textContent = value === null || value === undefined ? "–" : value.toFixed(decimals);
      });
    });
  }

  function seek(event) {
    if (!player || !(event.buttons & 1)) return;
    const box = timeline.getBoundingClientRect();
    const left = Number(timeline.dataset.left), right = Number(timeline.dataset.right);
    const part = ((event.clientX - box.left) / box.width * 100 - left) / (right - left);
    player.play(false);
    player.show(Math.min(1, Math.max(0, part)) * player.duration);
    event.preventDefault();
  }

  holder.addEventListener("loaded", (event) => {
    player = event.detail;
    colours = Object.fromEntries(Object.entries(hex).map(([name, text]) => [name, linear(text)]));
    colours.plain = linear("#d6d4cc");
    nearToFar = nearToFarHex.map(linear);
    // By name: the loader adds the nodes in the order in which it happens to finish them.
    const parts = new Map(paint.parts.map((part) => [part.mesh, part]));
    player.scene.traverse((node) => {
      if (node.isMesh && node.material.vertexColors) surfaces.push(surfaceOf(node, parts.get(node.userData.name)));
    });
    document.getElementById("paint").hidden = false;
  });
  holder.addEventListener("shown", () => { showCursor(); showPaint(); });
  document.getElementById("paint").addEventListener("change", showPaint);
  timeline.addEventListener("pointerdown", seek);
  timeline.addEventListener("pointermove", seek);
})();
