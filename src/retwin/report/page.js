// Draws the plots in the page's colours, and again when these or the width change.
(() => {
  "use strict";
  const specs = JSON.parse(document.getElementById("specs").textContent);
  const root = document.documentElement;

  const paint = (value, style) => {
    if (typeof value === "string" && value.startsWith("@")) {
      const [name, alpha] = value.slice(1).split("/");
      const hex = style.getPropertyValue("--" + name).trim();
      if (!alpha) return hex;
      const parts = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
      return `rgba(${parts.join(",")},${alpha})`;
    }
    if (Array.isArray(value)) return value.map((each) => paint(each, style));
    if (value && typeof value === "object") {
      return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, paint(v, style)]));
    }
    return value;
  };

  const draw = () => {
    const style = getComputedStyle(root);
    for (const [id, spec] of Object.entries(specs)) {
      const place = document.getElementById(id);
      const layout = paint(spec.layout, style);
      layout.height = spec.height * (root.dataset.print ? 0.72 : 1);
      place.style.height = layout.height + "px";
      layout.width = place.clientWidth;
      // The wheel scrolls the page, also over a picture in space.
      const config = { displayModeBar: false, scrollZoom: false };
      Plotly.react(place, { data: paint(spec.data, style), layout, config, frames: spec.frames });
    }
  };

  draw();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  let waiting = 0;
  let width = root.clientWidth;
  window.addEventListener("resize", () => {
    if (root.clientWidth === width || root.dataset.print) return;
    width = root.clientWidth;
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(draw);
  });
  // Paper is white and narrower than most screens.
  window.addEventListener("beforeprint", () => {
    root.dataset.print = "yes";
    draw();
  });
  window.addEventListener("afterprint", () => {
    delete root.dataset.print;
    draw();
  });
})();
