// Draws the plots in the page's colours, and again when these or the width change.
const page = (() => {
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

  // What all plots have in common; the title of an axis is escaped already where it comes from a spec.
  const family = getComputedStyle(document.body).fontFamily;
  const escaped = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;");
  const styled = (given) => ({
    gridcolor: "@grid", linecolor: "@rule", zeroline: false, fixedrange: true, automargin: true,
    ticks: "outside", tickcolor: "@rule", ticklen: 4,
    ...given, title: { standoff: 8, font: { size: 13 }, ...given.title },
  });
  const axis = (text) => styled({ title: { text: escaped(text) } });
  const layout = {
    font: { family, size: 13, color: "@muted" }, paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)", margin: { l: 8, r: 12, t: 8, b: 8 }, showlegend: false,
    dragmode: false, hoverlabel: { font: { family, size: 13 } },
  };

  // The wheel scrolls the page, also over a picture in space.
  const config = { displayModeBar: false, scrollZoom: false };
  const plot = (place, data, layout) => {
    const style = getComputedStyle(root);
    const height = layout.height * (root.dataset.print ? 0.72 : 1);
    place.style.height = height + "px";
    const painted = { ...paint(layout, style), height, width: place.clientWidth };
    Plotly.react(place, { data: paint(data, style), layout: painted, config });
  };
  const drawn = [() => {
    for (const [id, spec] of Object.entries(specs)) {
      const place = document.getElementById(id);
      const given = { ...spec.layout, ...(place.clientWidth < 600 ? spec.narrow : {}) };
      const axes = Object.entries(given).filter(([key]) => key.includes("axis"));
      const dressed = Object.fromEntries(axes.map(([key, each]) => [key, styled(each)]));
      plot(place, spec.data, { ...layout, ...given, ...dressed, height: spec.height });
    }
  }];
  const draw = () => drawn.forEach((each) => each());

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
  // Paper is white and narrower than most screens, and does not scroll.
  const tables = document.querySelectorAll(".scroll > table");
  window.addEventListener("beforeprint", () => {
    root.dataset.print = "yes";
    draw();
    tables.forEach((table) => {
      table.style.zoom = Math.min(1, table.parentElement.clientWidth / table.offsetWidth);
    });
  });
  window.addEventListener("afterprint", () => {
    delete root.dataset.print;
    tables.forEach((table) => { table.style.zoom = ""; });
    draw();
  });

  return { axis, drawn, escaped, layout, plot };
})();
