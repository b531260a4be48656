// The explorer: draws the trajectory that is picked, and moves through its time.
const explorer = async (place) => {
  "use strict";
  const content = JSON.parse(document.getElementById("explorer-content").textContent);
  const at = (name) => document.getElementById("explore-" + name);

  if (!window.DecompressionStream) {
    at("answer").textContent = "The explorer requires a browser of 2023 or later.";
    return () => {};
  }
  // See `packed` in explorer.py.
  const unpack = async (packed) => {
    const plane = new Uint8Array(await page.inflate(packed.codes));
    const count = plane.length / 2;
    const stride = packed.shape.slice(packed.axis + 1).reduce((a, b) => a * b, 1);
    const length = packed.shape[packed.axis];
    const codes = new Uint16Array(count);
    const flat = new Array(count);
    for (let i = 0; i < count; i += 1) {
      const change = plane[i] + 256 * plane[count + i];
      codes[i] = Math.floor(i / stride) % length ? codes[i - stride] + change : change;
      flat[i] = codes[i] === 65535 ? null : packed.low + packed.step * codes[i];
    }
    const shaped = (values, shape) => {
      if (shape.length < 2) return values;
      const size = values.length / shape[0];
      return Array.from({ length: shape[0] }, (_, i) =>
        shaped(values.slice(i * size, (i + 1) * size), shape.slice(1)));
    };
    return shaped(flat, packed.shape);
  };
  const names = ["commands", "nominal", "observed", "bands", "times"];
  const data = {};
  for (const name of names) data[name] = await unpack(content[name]);
  const shares = content.probabilities && await unpack(content.probabilities);
  const latent = content.latent;
  const pose = content.pose && {};
  const bodies = ["nominal", "updated", "observed"].filter((name) => content.pose && content.pose[name]);
  for (const name of bodies) pose[name] = await unpack(content.pose[name]);
  const seconds = data.nominal[0].map((_, i) => i / content.rate);
  const column = (rows, i) => rows.map((row) => row[i]);
  const titled = (name, unit) => (unit && unit !== "1" ? `${name}, ${unit}` : name);
  // A value with as many digits as its standard deviation justifies.
  const rounded = (value, deviation) => {
    if (value === null) return "–";
    const minus = (text) => text.replace("-", "−");
    if (deviation < 5e-4) return minus(String(Number(value.toPrecision(3))));
    const places = Math.min(3, Math.max(0, 1 - Math.floor(Math.log10(deviation))));
    const shown = Number(value.toFixed(places)) || 0;  // no negative zero
    return `${minus(shown.toFixed(places))} ± ${deviation.toFixed(places)}`;
  };
  let picked = 0;
  let moment = 0;

  // Commands at the bottom, outputs above them, on one axis of time.
  const outputs = () => {
    const rows = content.outputs.names.length + 1;
    const band = `@c${content.colour}`;
    const traces = [];
    const layout = {
      ...page.layout, height: 130 * rows + 40, shapes: [cursor(), ...shading()],
      xaxis: { ...page.axis("time, s"), range: [0, seconds[seconds.length - 1]], anchor: rows > 1 ? `y${rows}` : "y" },
    };
    const share = (row) => [1 - (row + 0.88) / rows, 1 - row / rows];
    content.outputs.names.forEach((name, d) => {
      const y = d ? `y${d + 1}` : "y";
      layout[`yaxis${d ? d + 1 : ""}`] = { ...page.axis(titled(name, content.outputs.units[d])), domain: share(d), nticks: 5 };
      const ideal = column(data.nominal[picked], d);
      const shown = (values) => at("minus").checked ? values.map((value, i) => value === null ? null : value - ideal[i]) : values;
      const edges = data.bands[picked].map((rows) => shown(column(rows, d)));
      [[0, 4, 0.2], [1, 3, 0.4]].forEach(([low, high, alpha]) => traces.push({
        type: "scatter", mode: "lines", x: [...seconds, ...[...seconds].reverse()],
        y: [...edges[high], ...[...edges[low]].reverse()], yaxis: y, fill: "toself",
        fillcolor: `${band}/${alpha}`, line: { width: 0 }, hoverinfo: "skip",
      }));
      traces.push(line(shown(ideal), y, "nominal", { color: "@muted", width: 1.4, dash: "dot" }));
      traces.push(line(shown(column(data.observed[picked], d)), y, "measured", { color: "@ink", width: 1.7 }));
    });
    const units = [...new Set(content.inputs.units)];
    layout[`yaxis${rows > 1 ? rows : ""}`] = { ...page.axis(titled("commands", units.length === 1 ? units[0] : "")), domain: share(rows - 1), nticks: 5 };
    content.inputs.names.forEach((name, u) => traces.push(
      line(column(data.commands[picked], u), rows > 1 ? `y${rows}` : "y", name, { color: `@c${u % 8}`, width: 1.5, dash: ["solid", "dash", "dot", "dashdot"][u % 4] })));
    page.plot(at("outputs"), traces, layout);
    if (listening) return;
    listening = true;
    // A click anywhere in the plot sets the time.
    at("outputs").addEventListener("click", (event) => {
      if (event.target.closest(".modebar")) return;
      const axis = at("outputs")._fullLayout.xaxis;
      const x = axis.p2d(event.clientX - at("outputs").getBoundingClientRect().left - axis._offset);
      const found = Math.round(x * content.rate);
      if (found >= 0 && found < seconds.length) move(found);
    });
  };
  let listening = false;
  const line = (y, yaxis, name, style) => ({
    type: "scatter", mode: "lines", x: seconds, y, yaxis, name, line: style,
    hovertemplate: `${page.escaped(name)} %{y:.4g} at %{x:.1f} s<extra></extra>`,
  });
  const cursor = () => ({ type: "line", xref: "x", yref: "paper", x0: seconds[moment], x1: seconds[moment], y0: 0, y1: 1, line: { color: "@c1", width: 1.5 } });
  const shading = () => data.times[picked].filter((each) => each[0] !== null).map(([start, settle]) => ({
    type: "rect", xref: "x", yref: "paper", x0: start, x1: settle, y0: 0, y1: 1, fillcolor: "@grid", line: { width: 0 }, layer: "below",
  }));

  const through = (points) => ({ x: column(points, 0), y: column(points, 1), z: column(points, 2) });
  const chains = () => {
    const last = pose.nominal[0][0].length - 1;
    const path = (points, color) => ({ type: "scatter3d", ...through(points.map((chain) => chain[last])), mode: "lines", line: { color, width: 2 }, hoverinfo: "skip" });
    const chain = (points, name, color, width, opacity) => ({
      type: "scatter3d", ...through(points), name, mode: "lines+markers", opacity,
      line: { color, width }, marker: { color, size: 0.8 * width, line: { width: 0 } },
      hovertemplate: `${name}: %{x:.3f}, %{y:.3f}, %{z:.3f} m<extra></extra>`,
    });
    const { low, high } = content.pose;
    const most = Math.max(...low.map((value, i) => high[i] - value));
    const scene = { aspectmode: "manual", aspectratio: {}, camera: { eye: { x: 1.2, y: -1.32, z: 0.5 }, center: { x: 0, y: 0, z: -0.1 } } };
    ["x", "y", "z"].forEach((name, i) => {
      scene[`${name}axis`] = { range: [low[i], high[i]], title: { text: `${name}, m`, font: { size: 11 } }, tickfont: { size: 10 }, nticks: 5, color: "@muted", gridcolor: "@grid", linecolor: "@rule", zeroline: false, showspikes: false, showbackground: false };
      scene.aspectratio[name] = (high[i] - low[i]) / most;
    });
    const styles = { nominal: ["@observed", 7, 0.55], updated: [`@c${content.colour}`, 6, 0.9], observed: ["@ink", 4, 1] };
    page.plot(at("pose"), [
      ...bodies.map((name) => path(pose[name][picked], styles[name][0])),
      ...bodies.map((name) => chain(pose[name][picked][moment], labels[name], ...styles[name])),
    ], { ...page.layout, height: 420, margin: { l: 24, r: 8, t: 0, b: 0 }, scene, uirevision: "kept" });
  };
  const labels = { nominal: "nominal", updated: "updated twin", observed: "measured" };

  const cell = (tag, text, more = {}) => Object.assign(document.createElement(tag), { textContent: text, ...more });
  const row = (cells) => { const made = document.createElement("tr"); made.append(...cells); return made; };
  const fill = (table, head, rows) => {
    const top = document.createElement("thead");
    const body = document.createElement("tbody");
    top.append(row(head.map((text) => cell("th", text, { scope: "col" }))));
    body.append(...rows);
    table.replaceChildren(top, body);
  };
  const probabilities = () => {
    if (!shares) return;
    const truth = content.truth[picked];
    fill(at("probabilities"), ["Probability, %", ...content.classes], content.sources.map((source, s) => {
      const values = shares[s][picked];
      const best = values.indexOf(Math.max(...values));
      const cells = values.map((value, k) => {
        const percent = Math.round(100 * value);
        const made = cell("td", percent ? String(percent) : "", { className: [k === truth ? "right" : "", k === best ? "best" : ""].join(" ").trim() });
        made.style.setProperty("--share", `${percent}%`);
        made.style.setProperty("--colour", `var(--c${source.colour})`);
        return made;
      });
      return row([cell("th", source.name, { scope: "row" }), ...cells]);
    }));
  };
  const infer = () => {
    if (!latent) return;
    const head = ["Segment", ...latent.names.map((name, k) => titled(name, latent.units[k]))];
    const there = data.times[picked].map((each, m) => [each, m]).filter(([each]) => each[0] !== null);
    const texts = there.map(([, m]) => latent.z[picked][m].map((value, k) => rounded(value, latent.deviation[picked][m][k])));
    const known = latent.names.map((_, k) => texts.some((each) => each[k] !== "–"));
    const kept = (cells) => cells.filter((_, k) => known[k]);
    fill(at("z"), [head[0], ...kept(head.slice(1))], there.map(([each, m], i) => row([
      cell("th", `${m + 1}: from ${each[0].toFixed(1)} s`, { scope: "row" }),
      ...kept(texts[i]).map((text) => cell("td", text)),
    ])));
  };
  const answer = () => {
    const truth = content.truth[picked];
    const wrong = content.sources.map((source, s) => {
      const values = shares[s][picked];
      const best = values.indexOf(Math.max(...values));
      return best === truth ? null : `${source.name} diagnoses ${content.classes[best]}`;
    }).filter(Boolean);
    const all = content.sources.length;
    const which = wrong.length > 3 ? "" : `; ${wrong.join(", ")}`;
    const verdict = !all ? "" : wrong.length ? `${all - wrong.length} of ${all} sources are correct${which}.` : `All ${all} sources are correct.`;
    at("answer").textContent = `True class: ${content.classes[truth]}. ${verdict}`;
  };

  const move = (to) => {
    moment = to;
    at("time").value = moment;
    at("now").textContent = `${seconds[moment].toFixed(1)} s`;
    if (!at("outputs").data) return;
    Plotly.relayout(at("outputs"), { "shapes[0].x0": seconds[moment], "shapes[0].x1": seconds[moment] });
    if (!pose) return;
    const now = bodies.map((name) => through(pose[name][picked][moment]));
    const moved = Object.fromEntries(["x", "y", "z"].map((name) => [name, now.map((each) => each[name])]));
    Plotly.restyle(at("pose"), moved, bodies.map((_, i) => bodies.length + i));
  };
  const pick = (to) => {
    picked = (to + content.ids.length) % content.ids.length;
    at("pick").value = String(picked);
    draw();
    answer();
    probabilities();
    infer();
  };
  const draw = () => {
    if (!page.visible(place)) return;
    outputs();
    if (pose) chains();
  };

  // The root mean square of the measured minus the nominal output, each divided by its range.
  const ranges = content.outputs.names.map((_, d) => {
    const all = data.nominal.flatMap((rows) => column(rows, d));
    return all.reduce((a, b) => Math.max(a, b), -Infinity) - all.reduce((a, b) => Math.min(a, b), Infinity) || 1;
  });
  const errors = content.ids.map((_, i) => {
    let total = 0, count = 0;
    data.observed[i].forEach((row, p) => row.forEach((value, d) => {
      if (value === null) return;
      total += ((value - data.nominal[i][p][d]) / ranges[d]) ** 2;
      count += 1;
    }));
    return count ? Math.sqrt(total / count) : 0;
  });
  const wrong = content.ids.map((_, i) => Boolean(shares) && shares.some((each) =>
    each[i].indexOf(Math.max(...each[i])) !== content.truth[i]));
  const chosen = (name) => (at(name) ? at(name).value : "");
  let sequence = [];
  const list = () => {
    const kept = content.ids.map((_, i) => i).filter((i) =>
      (chosen("class") === "" || content.truth[i] === Number(chosen("class")))
      && (chosen("right") === "" || wrong[i] === (chosen("right") === "wrong")));
    const titles = content.classes.length ? content.classes : [""];
    const option = (i) => new Option(content.ids[i], String(i));
    if (chosen("order") === "error") {
      kept.sort((a, b) => errors[b] - errors[a]);
      at("pick").replaceChildren(...kept.map(option));
    } else {
      at("pick").replaceChildren(...titles.map((name, k) => {
        const group = Object.assign(document.createElement("optgroup"), { label: name });
        group.append(...kept.filter((i) => !content.classes.length || content.truth[i] === k).map(option));
        return group;
      }).filter((group) => group.children.length));
    }
    sequence = Array.from(at("pick").options, (each) => Number(each.value));
    if (!sequence.length) at("answer").textContent = "No trajectory matches these choices.";
    else if (!sequence.includes(picked)) pick(sequence[0]);
    else at("pick").value = String(picked);
  };
  if (at("class")) at("class").append(...content.classes.map((name, k) => new Option(name, String(k))));
  ["class", "right", "order"].forEach((name) => at(name) && at(name).addEventListener("change", list));
  const step = (by) => sequence.length && pick(sequence[(sequence.indexOf(picked) + by + sequence.length) % sequence.length]);
  at("time").max = seconds.length - 1;
  at("pick").addEventListener("change", (event) => pick(Number(event.target.value)));
  at("minus").addEventListener("change", outputs);
  at("before").addEventListener("click", () => step(-1));
  at("next").addEventListener("click", () => step(1));
  at("time").addEventListener("input", (event) => move(Number(event.target.value)));
  let playing = 0;
  at("play").addEventListener("click", () => {
    clearInterval(playing);
    const go = at("play").getAttribute("aria-pressed") !== "true";
    at("play").setAttribute("aria-pressed", String(go));
    at("play").textContent = go ? "❚❚" : "▶";
    if (go) playing = setInterval(() => move((moment + 1) % seconds.length), 1000 / Math.min(content.rate, 20));
  });
  moment = Math.round(0.3 * (seconds.length - 1));
  // A link to #trajectory=NAME shows that trajectory.
  const follow = () => {
    const [what, name] = location.hash.slice(1).split("=");
    const found = what === "trajectory" ? content.ids.indexOf(decodeURIComponent(name)) : -1;
    if (found < 0) return;
    ["class", "right"].forEach((name) => { if (at(name)) at(name).value = ""; });
    list();
    pick(found);
    place.scrollIntoView();
  };
  window.addEventListener("hashchange", follow);
  list();
  pick(sequence[0]);
  move(moment);
  follow();
  place.dataset.ready = "yes";
  return draw;
};
// Its data are unpacked when it comes near the screen, or once nothing else is to be done, so that
// it prints without having been opened.
(() => {
  "use strict";
  const place = document.getElementById("explore");
  if (!place) return;
  let begun = null;
  let draw = () => { begun ||= explorer(place).then((found) => { draw = found; }); };
  page.near(place, () => draw());
  const idle = window.requestIdleCallback || setTimeout;
  window.addEventListener("load", () => idle(() => draw()));
})();
