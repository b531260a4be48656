// Draws each plot in the page's colours when it comes near the screen, and again when these or the
// width change: text and first screen are there before anything is drawn.
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
    gridcolor: "@grid", linecolor: "@rule", zeroline: false, automargin: true,
    ticks: "outside", tickcolor: "@rule", ticklen: 4,
    ...given, title: { standoff: 8, font: { size: 13 }, ...given.title },
  });
  const axis = (text) => styled({ title: { text: escaped(text) } });
  const layout = {
    font: { family, size: 13, color: "@muted" }, paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)", margin: { l: 8, r: 12, t: 8, b: 8 }, showlegend: false,
    modebar: { bgcolor: "rgba(0,0,0,0)", color: "@muted", activecolor: "@ink" },
    dragmode: false, hoverlabel: { font: { family, size: 13 } },
  };

  // The wheel scrolls the page, also over a picture in space; buttons zoom and download.
  const config = {
    displaylogo: false, scrollZoom: false, displayModeBar: root.clientWidth < 600 ? false : "hover",
    toImageButtonOptions: { format: "png", scale: 2 },
  };
  // Bytes from deflated ones in base 64.
  const inflate = async (text) => {
    const bytes = Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  };
  // The plot library is most of the page's script: it is unpacked when the first plot is drawn.
  let loading = null;
  const load = async () => {
    const code = await inflate(document.getElementById("plotly").textContent);
    const run = document.createElement("script");
    run.textContent = new TextDecoder().decode(code);
    document.head.append(run);
  };
  const plot = (place, data, layout) => {
    if (window.Plotly) react(place, data, layout);
    else if (window.DecompressionStream) (loading ||= load()).then(() => react(place, data, layout));
    else place.textContent = "This figure requires a browser of 2023 or later.";
  };
  const react = (place, data, layout) => {
    if (!place.data) place.replaceChildren();
    const style = getComputedStyle(root);
    const height = layout.height * (root.dataset.print ? 0.72 : 1);
    place.style.height = height + "px";
    const painted = { ...paint(layout, style), height, width: place.clientWidth };
    const buttons = data.some((each) => each.type === "scatter3d")
      ? ["toImage", "orbitRotation", "zoom3d", "pan3d", "resetCameraDefault3d"]
      : ["toImage", "zoom2d", "pan2d", "resetScale2d"];
    Plotly.react(place, { data: paint(data, style), layout: painted, config: { ...config, modeBarButtons: [buttons] } });
  };
  const visible = (place) => !place.closest("details.part:not([open])");
  // The function that draws an element, called when that is near the screen; closed sections never are.
  const pictures = new Map();
  const observer = new IntersectionObserver((entries) => {
    entries.filter((each) => each.isIntersecting).forEach(({ target }) => {
      observer.unobserve(target);
      pictures.get(target)();
    });
  }, { rootMargin: "400px" });
  const near = (place, draw) => {
    pictures.set(place, draw);
    observer.observe(place);
  };
  const redraw = () => pictures.forEach((_, place) => observer.observe(place));
  for (const [id, spec] of Object.entries(specs)) {
    const place = document.getElementById(id);
    if (place) near(place, () => {
      const given = { ...spec.layout, ...(place.clientWidth < 600 ? spec.narrow : {}) };
      const axes = Object.entries(given).filter(([key]) => key.includes("axis"));
      const dressed = Object.fromEntries(axes.map(([key, each]) => [key, styled(each)]));
      plot(place, spec.data, { ...layout, ...given, ...dressed, height: spec.height });
    });
  }
  const parts = Array.from(document.querySelectorAll("details.part"));
  // A link to a section, or to something within one, opens it.
  const unfold = () => {
    const name = location.hash.slice(1);
    const target = document.getElementById(name.startsWith("trajectory=") ? "explorer" : name);
    const part = target && (target.querySelector("details.part") || target.closest("details.part"));
    if (!part || part.open) return;
    part.open = true;
    target.scrollIntoView();
  };
  window.addEventListener("hashchange", unfold);
  unfold();
  const all = document.getElementById("unfold");
  if (all) all.addEventListener("click", () => {
    const open = all.getAttribute("aria-pressed") !== "true";
    parts.forEach((part) => { part.open = open; });
    all.setAttribute("aria-pressed", String(open));
    all.textContent = open ? "Close all sections" : "Open all sections";
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  let width = root.clientWidth;
  window.addEventListener("resize", () => {
    if (root.clientWidth === width || root.dataset.print) return;
    width = root.clientWidth;
    redraw();
  });
  // Paper is white and narrower than most screens, and does not scroll.
  const tables = document.querySelectorAll(".scroll > table");
  // Height of the first sheet within its margins, less that of the line on top, in CSS pixels.
  const SHEET = 950;
  let folded = [];
  window.addEventListener("beforeprint", () => {
    root.dataset.print = "yes";
    folded = parts.filter((part) => !part.open);
    folded.forEach((part) => { part.open = true; });
    pictures.forEach((draw) => draw());
    const first = document.getElementById("summary");
    if (first) {
      first.style.zoom = Math.min(1, SHEET / first.offsetHeight);
      // Smaller print has room for wider plots.
      pictures.forEach((draw, place) => first.contains(place) && draw());
    }
    tables.forEach((table) => {
      table.style.zoom = Math.min(1, table.parentElement.clientWidth / table.offsetWidth);
    });
  });
  window.addEventListener("afterprint", () => {
    delete root.dataset.print;
    const first = document.getElementById("summary");
    if (first) first.style.zoom = "";
    tables.forEach((table) => { table.style.zoom = ""; });
    folded.forEach((part) => { part.open = false; });
    redraw();
  });

  return { axis, escaped, inflate, layout, near, plot, visible };
})();
