"use strict";
// One cursor for all charts: the frame under the pointer, in every chart over time and on the path.
(() => {
  const data = JSON.parse(document.getElementById("frame-data").textContent);
  if (!data) return;
  const readout = document.createElement("div");
  readout.id = "readout";
  readout.hidden = true;
  document.body.append(readout);

  const nearest = (measure) => {
    let best = 0;
    for (let i = 1; i < data.text.length; i++) if (measure(i) < measure(best)) best = i;
    return best;
  };
  const cursors = document.querySelectorAll(".cursor");
  const hide = () => {
    readout.hidden = true;
    for (const cursor of cursors) cursor.setAttribute("visibility", "hidden");
  };
  const show = (event) => {
    const svg = event.currentTarget;
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const frame = svg.classList.contains("ground")
      ? nearest((i) => Math.hypot(data.path[i][0] - point.x, data.path[i][1] - point.y))
      : nearest((i) => Math.abs(data.time[i] - point.x));
    for (const cursor of cursors) {
      const places = cursor.tagName === "line"
        ? { x1: data.time[frame], x2: data.time[frame] }
        : { cx: data.path[frame][0], cy: data.path[frame][1] };
      for (const [name, value] of Object.entries(places)) cursor.setAttribute(name, value);
      cursor.setAttribute("visibility", "visible");
    }
    readout.textContent = data.text[frame];
    readout.hidden = false;
    const half = readout.offsetWidth / 2 + 6;
    readout.style.left = `${Math.min(Math.max(event.clientX, half), innerWidth - half)}px`;
    readout.style.top = `${Math.max(event.clientY, 52)}px`;
  };
  for (const svg of document.querySelectorAll("svg.timeline, svg.ground")) {
    svg.addEventListener("pointermove", show);
    svg.addEventListener("pointerleave", hide);
  }
})();
