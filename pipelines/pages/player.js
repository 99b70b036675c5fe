// Plays all elements "figure.player" of the page. They share one WebGL renderer, because browsers allow about 16 contexts:
// it renders each visible player, and the image is copied to that player's 2D canvas. The page provides THREE and GLTFLoader.
"use strict";
(function () {
  const FIELD_OF_VIEW_DEG = 32;
  const PLAIN_OBJECT = new THREE.Color("#d6d4cc").convertSRGBToLinear();
  let renderer = null;
  const players = [];

  function makeRenderer() {
    const webgl = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    webgl.outputEncoding = THREE.sRGBEncoding;
    webgl.shadowMap.enabled = true;
    webgl.shadowMap.type = THREE.PCFSoftShadowMap;
    webgl.setClearColor(0xffffff, 0);
    return webgl;
  }

  function bytesOf(element) {
    const text = atob(element.textContent.trim());
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return bytes;
  }

  function unpacked(element) {
    const packed = new Blob([bytesOf(element)]).stream();
    return new Response(packed.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  }

  class Player {
    constructor(figure) {
      this.figure = figure;
      this.canvas = figure.querySelector("canvas");
      this.context = this.canvas.getContext("2d");
      this.view = JSON.parse(figure.querySelector(".view").textContent);
      this.slider = figure.querySelector("input[type=range]");
      this.button = figure.querySelector("button.play");
      this.clock = figure.querySelector(".clock");
      this.scene = new THREE.Scene();
      this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, 0.005, 50);
      this.target = new THREE.Vector3(...this.view.centre);
      this.azimuth = this.view.azimuth_rad;
      this.elevation = this.view.elevation_rad;
      this.zoom = 1;
      this.seconds = 0;
      this.playing = false;
      this.visible = false;
      this.dirty = true;
      this.painted = [];
    }

    // A report has dozens of motions: visible ones are loaded first, then the others one after another.
    wait() {
      new IntersectionObserver((entries) => {
        this.visible = entries[entries.length - 1].isIntersecting;
        this.dirty = true;
        if (this.visible) this.ready();
      }, { rootMargin: "150px" }).observe(this.canvas);
    }

    ready() {
      this.loading = this.loading || this.load().catch((error) => tell(this.figure, error));
      return this.loading;
    }

    start() {
      const part = startAt();
      this.show(part === null ? 0 : part * this.duration);
      this.play(part === null && !window.matchMedia("(prefers-reduced-motion: reduce)").matches);
      this.draw();
    }

    async load() {
      const buffer = await unpacked(this.figure.querySelector(".glb"));
      const gltf = await new Promise((done, fail) => new THREE.GLTFLoader().parse(buffer, "", done, fail));
      gltf.scene.traverse((node) => this.prepare(node));
      this.scene.add(gltf.scene);
      this.mixer = new THREE.AnimationMixer(gltf.scene);
      for (const clip of gltf.animations) this.mixer.clipAction(clip).play();
      this.duration = Math.max((this.view.frames - 1) / this.view.fps, 1 / this.view.fps);
      this.addLights();
      this.addGround();
      this.listen();
      this.announce("loaded");
      this.start();
      const drawn = document.documentElement.dataset;
      drawn.players = String(Number(drawn.players || 0) + 1);
    }

    // Events for other scripts of the page: "loaded" once, "shown" whenever the displayed time changes.
    announce(name) {
      this.figure.dispatchEvent(new CustomEvent(name, { bubbles: true, detail: this }));
    }

    frame() {
      return Math.min(this.view.frames - 1, Math.round(this.seconds * this.view.fps));
    }

    prepare(node) {
      if (!node.isMesh) return;
      node.castShadow = true;
      node.receiveShadow = true;
      node.frustumCulled = false;
      node.material.side = THREE.DoubleSide;
      node.material.shadowSide = THREE.DoubleSide;
      if (node.material.vertexColors) this.painted.push(node.material);
    }

    addLights() {
      const radius = this.view.radius_m;
      this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb8b4ac, 0.62));
      const sun = new THREE.DirectionalLight(0xffffff, 0.62);
      sun.position.copy(this.target).add(new THREE.Vector3(0.5, 1.6, 0.4).multiplyScalar(radius * 2));
      sun.target.position.copy(this.target);
      sun.castShadow = true;
      sun.shadow.mapSize.set(2048, 2048);
      sun.shadow.bias = -0.0004;
      sun.shadow.normalBias = 0.002;
      sun.shadow.radius = 5;
      const box = sun.shadow.camera;
      box.left = box.bottom = -radius * 1.3;
      box.right = box.top = radius * 1.3;
      box.near = 0.01;
      box.far = radius * 6;
      this.headlight = new THREE.DirectionalLight(0xffffff, 0.25);
      this.scene.add(sun, sun.target, this.headlight, this.headlight.target);
    }

    addGround() {
      if (this.view.ground_m === null) return;
      const cells = 2 * Math.ceil(this.view.radius_m * 1.6 / 0.1);
      const grid = new THREE.GridHelper(cells * 0.1, cells, 0xcfcfca, 0xdedeDA);
      grid.position.set(this.target.x, this.view.ground_m, this.target.z);
      const floor = new THREE.Mesh(new THREE.PlaneGeometry(cells * 0.1, cells * 0.1), new THREE.ShadowMaterial({ opacity: 0.16 }));
      floor.rotation.x = -Math.PI / 2;
      floor.position.copy(grid.position);
      floor.position.y -= 0.0005;
      floor.receiveShadow = true;
      this.scene.add(grid, floor);
    }

    listen() {
      this.button.addEventListener("click", () => this.play(!this.playing));
      this.slider.addEventListener("input", () => { this.play(false); this.show(Number(this.slider.value) * this.duration); });
      const contact = this.figure.querySelector("input.contact");
      if (contact) contact.addEventListener("change", () => this.paint(contact.checked));
      this.canvas.addEventListener("pointerdown", (event) => { this.canvas.setPointerCapture(event.pointerId); });
      this.canvas.addEventListener("pointermove", (event) => { if (event.buttons) this.drag(event); });
      this.canvas.addEventListener("contextmenu", (event) => event.preventDefault());
      this.canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
      this.canvas.addEventListener("keydown", (event) => this.key(event));
      new ResizeObserver(() => this.draw()).observe(this.canvas);
    }

    drag(event) {
      const height = this.canvas.clientHeight;
      if (event.shiftKey || event.buttons === 2) {
        const scale = 2 * this.distance() * Math.tan(FIELD_OF_VIEW_DEG * Math.PI / 360) / height;
        const right = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 0);
        const up = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 1);
        this.target.addScaledVector(right, -event.movementX * scale).addScaledVector(up, event.movementY * scale);
      } else {
        this.azimuth -= event.movementX / height * 3;
        this.elevation = Math.min(1.5, Math.max(-1.5, this.elevation + event.movementY / height * 3));
      }
      this.dirty = true;
    }

    wheel(event) {
      if (document.activeElement !== this.canvas) return;
      event.preventDefault();
      this.zoom = Math.min(8, Math.max(0.3, this.zoom * Math.exp(-event.deltaY * 0.0012)));
      this.dirty = true;
    }

    key(event) {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === " ") this.play(!this.playing);
      else if (step) { this.play(false); this.show(this.seconds + step / this.view.fps); }
      else return;
      event.preventDefault();
    }

    paint(on) {
      for (const material of this.painted) {
        material.vertexColors = on;
        material.color.copy(on ? new THREE.Color(1, 1, 1) : PLAIN_OBJECT);
        material.needsUpdate = true;
      }
      this.dirty = true;
    }

    play(on) {
      this.playing = on && this.view.frames > 1;
      this.button.textContent = this.playing ? "Pause" : "Play";
      this.button.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    }

    show(seconds) {
      this.seconds = Math.min(this.duration, Math.max(0, seconds));
      // A hair before the end: the mixer wraps to the start exactly at the clip's length.
      this.mixer.setTime(Math.min(this.seconds, this.duration - 1e-4));
      this.slider.value = this.seconds / this.duration;
      this.clock.textContent = `frame ${this.frame()} of ${this.view.frames - 1} · ${this.seconds.toFixed(2)} s`;
      this.dirty = true;
      this.announce("shown");
    }

    advance(seconds) {
      if (!this.playing || !this.visible) return;
      const next = this.seconds + seconds;
      this.show(next > this.duration + 0.4 ? 0 : next > this.duration ? this.duration : next);
      if (next > this.duration) this.seconds = next;
    }

    distance() {
      const half = Math.tan(FIELD_OF_VIEW_DEG * Math.PI / 360) * Math.min(1, this.camera.aspect);
      return this.view.radius_m * 0.9 / Math.sin(Math.atan(half)) / this.zoom;
    }

    draw() {
      if (!this.mixer) return;
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      const width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
      if (!width || !height) return;
      if (this.canvas.width !== width || this.canvas.height !== height) { this.canvas.width = width; this.canvas.height = height; }
      this.camera.aspect = width / height;
      const distance = this.distance();
      this.camera.near = distance / 100;
      this.camera.far = distance * 20;
      this.camera.updateProjectionMatrix();
      const level = Math.cos(this.elevation) * distance;
      this.camera.position.set(Math.sin(this.azimuth) * level, Math.sin(this.elevation) * distance, Math.cos(this.azimuth) * level);
      this.camera.position.add(this.target);
      this.camera.lookAt(this.target);
      this.headlight.position.copy(this.camera.position);
      this.headlight.target.position.copy(this.target);
      renderer.setSize(width, height, false);
      renderer.render(this.scene, this.camera);
      this.context.clearRect(0, 0, width, height);
      this.context.drawImage(renderer.domElement, 0, 0);
      this.dirty = false;
    }
  }

  function startAt() {
    const match = /(?:^#|&)t=([0-9.]+)/.exec(window.location.hash);
    return match ? Math.min(1, Number(match[1])) : null;
  }

  async function main() {
    renderer = makeRenderer();
    for (const figure of document.querySelectorAll("figure.player")) players.push(new Player(figure));
    for (const player of players) player.wait();
    window.addEventListener("hashchange", () => { for (const player of players) if (player.mixer) player.start(); });
    let before = performance.now();
    const loop = (now) => {
      const elapsed = Math.min(0.1, (now - before) / 1000);
      before = now;
      for (const player of players) {
        player.advance(elapsed);
        if (player.dirty && player.visible) player.draw();
      }
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
    for (const player of players) await player.ready();
  }

  function tell(figure, error) {
    const note = figure.querySelector(".fallback");
    note.hidden = false;
    note.textContent = `This browser could not draw the motion (${error}).`;
  }

  main().catch((error) => { for (const figure of document.querySelectorAll("figure.player")) tell(figure, error); });
})();
