"use strict";
// The mesh on a canvas: packed in the page, unpacked when it comes into view, turned with the pointer or the arrow keys.
(() => {
  const canvas = document.getElementById("turntable");
  if (!canvas) return;
  const gl = typeof DecompressionStream === "function" && canvas.getContext("webgl2", { antialias: true, alpha: true });
  if (!gl) {
    canvas.hidden = true;
    canvas.parentElement.querySelector(".controls").hidden = true;
    document.getElementById("turntable-none").hidden = false;
    return;
  }
  const facts = JSON.parse(document.getElementById("turntable-facts").textContent);
  const low = facts.low, high = facts.high;
  const size = high.map((value, i) => value - low[i]);
  const center = high.map((value, i) => (value + low[i]) / 2);
  const radius = Math.max(Math.hypot(...size) / 2, 1e-6);
  const start = () => ({ turn: facts.turn, tilt: 0.75, distance: 2.4 * radius, target: [...center] });
  let view = start(), counts = null, asked = false;
  const shape = document.getElementById("turntable-shape");
  const showPath = document.getElementById("turntable-path");
  const cut = document.getElementById("turntable-cut");

  const VERTEX = `#version 300 es
    in vec3 place; in vec3 color; uniform mat4 matrix; uniform vec3 low; uniform float scale;
    out vec3 shade; out vec3 world;
    void main() { world = low + scale * place; shade = color; gl_Position = matrix * vec4(world, 1.0); }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 shade; in vec3 world; uniform float cut; uniform int mode; uniform vec3 line; out vec4 pixel;
    void main() {
      if (mode < 2 && world.y > cut) discard;
      vec3 normal = normalize(cross(dFdx(world), dFdy(world)));
      float light = 0.35 + 0.65 * abs(dot(normal, normalize(vec3(0.4, 0.8, 0.45))));
      pixel = vec4(mode == 0 ? shade : mode == 1 ? vec3(light) : line, 1.0);
    }`;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "place");
  gl.bindAttribLocation(program, 1, "color");
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const [matrix, cutAt, mode, line] = ["matrix", "cut", "mode", "line"].map(uniform);
  gl.uniform3fv(uniform("low"), low);
  gl.uniform1f(uniform("scale"), facts.scale);
  gl.uniform3f(line, 0.85, 0.51, 0.17);
  gl.enable(gl.DEPTH_TEST);
  const meshes = gl.createVertexArray(), paths = gl.createVertexArray();

  const fill = (array, kind = gl.ARRAY_BUFFER) => {
    gl.bindBuffer(kind, gl.createBuffer());
    gl.bufferData(kind, array, gl.STATIC_DRAW);
  };
  const load = async () => {
    const text = document.getElementById("turntable-data").textContent;
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const data = await new Response(stream).arrayBuffer();
    let at = 0;
    const take = (Type, length) => {
      const part = new Type(data.slice(at, at + length * Type.BYTES_PER_ELEMENT));
      at += length * Type.BYTES_PER_ELEMENT;
      return part;
    };
    const path = take(Float32Array, 3 * facts.path);
    const indices = take(Int32Array, 3 * facts.faces);
    const columns = take(Uint16Array, 3 * facts.vertices);
    const colors = take(Uint8Array, 3 * facts.vertices);
    for (let i = 1; i < indices.length; i++) indices[i] += indices[i - 1];
    const places = new Uint16Array(3 * facts.vertices);
    for (let axis = 0; axis < 3; axis++) {
      let value = 0;
      for (let i = 0; i < facts.vertices; i++) {
        value = (value + columns[axis * facts.vertices + i]) & 65535;
        places[3 * i + axis] = value;
      }
    }
    gl.bindVertexArray(meshes);
    fill(places);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 0, 0);
    fill(colors);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    fill(new Uint32Array(indices.buffer), gl.ELEMENT_ARRAY_BUFFER);
    gl.bindVertexArray(paths);
    fill(path);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    counts = { faces: facts.faces, path: facts.path };
    canvas.dataset.ready = "yes";
    ask();
  };

  const eyeOf = () => {
    const { turn, tilt, distance, target } = view;
    return [
      target[0] + distance * Math.cos(tilt) * Math.sin(turn),
      target[1] + distance * Math.sin(tilt),
      target[2] + distance * Math.cos(tilt) * Math.cos(turn),
    ];
  };
  const basis = () => {
    const { turn, tilt } = view;
    const back = [Math.cos(tilt) * Math.sin(turn), Math.sin(tilt), Math.cos(tilt) * Math.cos(turn)];
    const right = [Math.cos(turn), 0, -Math.sin(turn)];
    const up = [-Math.sin(tilt) * Math.sin(turn), Math.cos(tilt), -Math.sin(tilt) * Math.cos(turn)];
    return { right, up, back };
  };
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const draw = () => {
    asked = false;
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!counts) return;
    const { right, up, back } = basis(), eye = eyeOf();
    const f = 1 / Math.tan(0.35), near = Math.max(view.distance / 200, 0.01), far = view.distance + 4 * radius;
    const aspect = width / height, fx = aspect > 1 ? f / aspect : f, fy = aspect > 1 ? f : f * aspect;
    const rows = [
      [fx * right[0], fx * right[1], fx * right[2], -fx * dot(right, eye)],
      [fy * up[0], fy * up[1], fy * up[2], -fy * dot(up, eye)],
    ];
    const a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
    rows.push([a * back[0], a * back[1], a * back[2], -a * dot(back, eye) + b]);
    rows.push([-back[0], -back[1], -back[2], dot(back, eye)]);
    gl.uniformMatrix4fv(matrix, false, [0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
    gl.uniform1f(cutAt, low[1] + (cut.value / 1000) * (size[1] + 1e-3));
    gl.uniform1i(mode, shape.checked ? 1 : 0);
    gl.enable(gl.CULL_FACE); // a room is looked into from outside
    gl.bindVertexArray(meshes);
    gl.drawElements(gl.TRIANGLES, 3 * counts.faces, gl.UNSIGNED_INT, 0);
    gl.disable(gl.CULL_FACE);
    if (showPath.checked) {
      gl.uniform1i(mode, 2);
      gl.bindVertexArray(paths);
      gl.drawArrays(gl.LINE_STRIP, 0, counts.path);
    }
  };
  const ask = () => {
    if (!asked) requestAnimationFrame(draw);
    asked = true;
  };
  const turn = (dx, dy) => {
    view.turn -= dx;
    view.tilt = Math.min(Math.max(view.tilt + dy, -1.55), 1.55);
    ask();
  };
  const move = (dx, dy) => {
    const { right, up } = basis();
    view.target = view.target.map((value, i) => value - view.distance * (dx * right[i] - dy * up[i]));
    ask();
  };
  const zoom = (factor) => {
    view.distance = Math.min(Math.max(view.distance * factor, 0.05 * radius), 12 * radius);
    ask();
  };

  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    const apart = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const unit = canvas.clientHeight || 1;
    if (pointers.size === 2) {
      zoom(apart / Math.max(spread(), 1));
      move(dx / unit / 2, dy / unit / 2);
    } else if (event.shiftKey || event.buttons & 6) move(dx / unit, dy / unit);
    else turn((3 * dx) / unit, (3 * dy) / unit);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(event.deltaY / 600));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => {
    view = start();
    ask();
  });
  const KEYS = {
    ArrowLeft: () => turn(0.1, 0), ArrowRight: () => turn(-0.1, 0), ArrowUp: () => turn(0, 0.1),
    ArrowDown: () => turn(0, -0.1), "+": () => zoom(0.9), "-": () => zoom(1.1),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  for (const input of [shape, showPath, cut]) input.addEventListener("input", ask);
  new ResizeObserver(ask).observe(canvas);
  new IntersectionObserver((entries, observer) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    observer.disconnect();
    load();
  }, { rootMargin: "600px" }).observe(canvas);
})();
