// The page of the monitor: texts of the server enter it as text nodes only, never as markup.
(() => {
  "use strict";
  const $ = (selector) => document.querySelector(selector);
  const main = $("#main");
  const INTERVAL = 700; // ms between two requests of new samples, at least
  const KEPT = 600; // samples that are drawn
  const SHOWN = 200; // machines that are listed without a search
  const DECADES = 7; // of the meter of evidence; the threshold is one below its end

  // Elements. A child that is no element becomes text.
  const h = (name, attributes = {}, ...children) => {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) {
      if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
      else if (value === true) made.setAttribute(key, "");
      else if (value !== false && value != null) made.setAttribute(key, value);
    }
    made.append(...children.flat().filter((each) => each != null && each !== false));
    return made;
  };
  const to = (...parts) => "#/" + parts.map(encodeURIComponent).join("/");

  // Numbers and times.
  const digits = (value, count = 3) => {
    if (value == null) return "–";
    if (value !== 0 && (Math.abs(value) >= 1e6 || Math.abs(value) < 1e-4)) return value.toExponential(1);
    return String(Number(value.toPrecision(Math.max(count, Math.ceil(Math.log10(Math.abs(value) + 1))))));
  };
  const percent = (value) => {
    if (value == null) return "–";
    const text = value > 0 && value < 0.0001 ? "< 0.01" : String(Number((100 * value).toPrecision(2)));
    return value >= 1e6 ? "over a million times" : value >= 10 ? `${digits(value)} times` : `${text} %`;
  };
  const pad = (value) => String(value).padStart(2, "0");
  const clock = (seconds) => {
    const at = new Date(1000 * seconds);
    return [at.getHours(), at.getMinutes(), at.getSeconds()].map(pad).join(":");
  };
  const day = (seconds) => {
    const at = new Date(1000 * seconds);
    return [at.getFullYear(), pad(at.getMonth() + 1), pad(at.getDate())].join("-");
  };
  const stamp = (seconds) => seconds == null ? "none yet" : `${day(seconds)} ${clock(seconds)}`;
  const span = (seconds) => {
    const [value, unit] = seconds < 100 ? [seconds, "s"] : seconds < 6000 ? [seconds / 60, "min"]
      : seconds < 172800 ? [seconds / 3600, "h"] : [seconds / 86400, "days"];
    return `${Math.round(value)} ${unit}`;
  };
  const counted = (count, one, many = one + "s") => `${count} ${count === 1 ? one : many}`;

  // The server.
  const request = async (path, options) => {
    const answer = await fetch(path, options);
    const body = await answer.json().catch(() => ({}));
    if (!answer.ok) throw Object.assign(new Error(body.error || `status ${answer.status}`), { status: answer.status });
    return body;
  };
  const askToken = () => new Promise((resolve) => {
    const dialog = $("#ask");
    const field = dialog.querySelector("input");
    field.value = "";
    dialog.returnValue = "";
    dialog.onclose = () => resolve(dialog.returnValue === "ok" ? field.value : null);
    dialog.showModal();
    field.focus();
  });
  const write = async (path, body) => {
    for (;;) {
      const token = sessionStorage.getItem("token") || await askToken();
      if (!token) throw new Error("no token was given, so that nothing was changed");
      try {
        const headers = { authorization: `Bearer ${token}`, "content-type": "application/json" };
        const made = await request(path, { method: "POST", headers, body: JSON.stringify(body) });
        sessionStorage.setItem("token", token);
        return made;
      } catch (error) {
        sessionStorage.removeItem("token");
        if (error.status !== 401) {
          if (error.status) sessionStorage.setItem("token", token);
          throw error;
        }
      }
    }
  };
  // A button that writes; its error is shown beside it.
  const action = (text, path, body, { first = false, disabled = false, done = () => refresh() } = {}) => {
    const error = h("p", { class: "error", role: "alert" });
    const button = h("button", { type: "button", class: first && "first", disabled, onclick: async () => {
      button.disabled = true;
      error.textContent = "";
      try {
        await write(path, typeof body === "function" ? body() : body);
        done();
      } catch (problem) {
        error.textContent = problem.message;
      }
      button.disabled = disabled;
    } }, text);
    return [button, error];
  };

  // What is common to several pages.
  const TONES = { alarm: ["alarm", "Alarm"], void: ["wait", "Promise void"], stopped: ["wait", "No samples"],
    outside: ["wait", "Outside calibration"], rate: ["wait", "Other rate"], impossible: ["wait", "Impossible value"], ok: ["ok", "As predicted"] };
  const tone = (asset) => TONES[asset.state] || TONES.ok;
  const badge = (asset) => h("span", { class: `badge ${tone(asset)[0]}` }, tone(asset)[1]);
  const fill = (part, value) => part.style.setProperty("--part", `${100 * Math.min(1, Math.max(0, value))}%`);
  const decades = (ratio) => ratio > 0 ? 1 + (Math.log10(ratio) - 1) / DECADES : 0;
  const verdict = (kind, ...texts) => h("div", { class: `verdict ${kind}` }, texts.map((each) => h("p", {}, each)));
  const facts = (...rows) => h("dl", { class: "facts" }, rows.map(([name, value, more]) =>
    h("div", {}, h("dt", {}, name), h("dd", {}, value, more && h("small", {}, more)))));
  const cause = (alarm) => !alarm.cause ? "cause not known yet"
    : `${fault(alarm.cause.name)} (${percent(alarm.cause.probability)})`;
  // An alarm whose samples a healthy machine explains best has no known cause.
  const fault = (name) => name === "Healthy" ? "no known fault" : name;
  const interval = ([value, low, high], unit = "", limit = false) => value == null ? ["–"]
    : [`${digits(value)} ${unit}`, `90 % interval ${digits(low)} to ${digits(high)}${limit ? ", at the end of its range" : ""}`];

  // The list of machines. Rows stay, so that the focus does; they move only while none has it.
  const fleet = () => {
    const rows = new Map();
    const head = h("div");
    const body = h("tbody");
    const search = h("input", { type: "search", placeholder: "Name", "aria-label": "Machines by name", oninput: () => refresh() });
    const more = h("p", { class: "quiet" });
    const tools = h("div", { class: "tools" }, search);
    const cells = ["Machine", "State", "Evidence for a change", "Last alarm", "Newest sample"];
    main.replaceChildren(h("h1", {}, "Machines"), head, tools, h("table", { class: "stack" },
      h("thead", {}, h("tr", {}, cells.map((each) => h("th", { scope: "col" }, each)))), body), more);
    const row = (name) => {
      const part = h("i");
      const made = { part, meter: h("span", { class: "meter", "aria-hidden": "true" }, part, h("b")),
        state: h("td"), evidence: h("span"), alarm: h("td", { class: "whole", "data-head": "Last alarm" }), time: h("td", { class: "whole", "data-head": "Newest sample" }) };
      made.element = h("tr", {}, h("th", { scope: "row" }, h("a", { href: to("asset", name) }, name)), made.state,
        h("td", { class: "wide whole" }, made.evidence, made.meter), made.alarm, made.time);
      return made;
    };
    return async () => {
      const { assets } = await request("/assets");
      const wanted = search.value.toLowerCase();
      const found = assets.filter((each) => each.asset.toLowerCase().includes(wanted));
      tools.hidden = assets.length < 10;
      const bad = assets.filter((each) => each.state === "alarm");
      const unsure = assets.filter((each) => tone(each)[0] === "wait");
      head.replaceChildren(assets.length === 0
        ? verdict("wait", "No machine is watched yet.", "Add one to the configuration, and send its samples.")
        : verdict(bad.length ? "alarm" : unsure.length ? "wait" : "ok",
          bad.length ? `${bad.length} of ${counted(assets.length, "machine")} ${bad.length === 1 ? "has an alarm" : "have alarms"} that nobody has acknowledged.`
            : `No open alarm in ${counted(assets.length, "machine")}.`,
          ...(unsure.length ? [`${counted(unsure.length, "machine needs", "machines need")} attention: see the column State.`]
            : bad.length === assets.length ? [] : [`${bad.length ? "All others" : "All"} do what their twins predict.`])));
      const listed = found.slice(0, SHOWN);
      for (const asset of listed) {
        if (!rows.has(asset.asset)) rows.set(asset.asset, row(asset.asset));
        const own = rows.get(asset.asset);
        const [kind, text] = tone(asset);
        if (own.state.textContent !== text) own.state.replaceChildren(badge(asset));
        own.meter.className = `meter ${asset.evidence >= 1 ? "alarm" : ""}`;
        own.evidence.textContent = !asset.evidence ? "none" : `${percent(asset.evidence)} of the threshold`;
        fill(own.part, decades(asset.evidence));
        const last = asset.alarm;
        const about = last ? `${stamp(last.time)}, ${cause(last)}` : "none";
        if (own.alarm.textContent !== about)
          own.alarm.replaceChildren(last ? h("a", { href: to("alarm", last.sequence) }, about) : about);
        own.time.textContent = stamp(asset.time);
        own.element.className = kind;
      }
      const order = listed.map((each) => rows.get(each.asset).element);
      const same = order.length === body.children.length && order.every((each, i) => body.children[i] === each);
      if (!same && !body.contains(document.activeElement)) body.replaceChildren(...order);
      more.textContent = found.length > SHOWN ? `${SHOWN} of ${found.length} machines are listed, the worst first: search for others by name.` : "";
    };
  };

  // Charts.
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const charts = [];
  const forget = () => charts.splice(0).forEach((each) => { each.watcher.disconnect(); each.plot?.destroy(); });
  const chart = (spec) => {
    const place = h("div", { class: "picture", role: "img", "aria-label": spec.about });
    const values = spec.series.map(() => h("output"));
    const key = (each, i) => h("li", {}, h("span", { class: `mark ${each.kind || ""} k${each.colour}` }), each.label, values[i]);
    const made = { spec, plot: null, data: null };
    made.element = h("figure", {}, h("figcaption", {}, spec.title),
      h("ul", { class: "keys" }, spec.series.map((each, i) => each.label ? key(each, i) : null)), place);
    made.set = (data) => {
      made.data = data;
      const now = data[0].length - 1;
      if (now < 0) return;
      if (!made.plot) made.draw(); else made.plot.setData(data);
    };
    made.draw = () => {
      made.plot?.destroy();
      if (place.clientWidth && made.data) made.plot = new uPlot(options(made, place.clientWidth, values), made.data, place);
    };
    made.watcher = new ResizeObserver(() => {
      if (!made.plot) made.draw(); else made.plot.setSize({ width: place.clientWidth, height: spec.height });
    });
    made.watcher.observe(place);
    charts.push(made);
    return made;
  };
  const options = ({ spec }, width, values) => {
    const axis = { stroke: colour("muted"), font: "13px system-ui, sans-serif", grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("rule"), width: 1, size: 4 } };
    const line = (each) => ({ stroke: each.hidden ? "transparent" : colour(each.colour === "ink" ? "ink" : each.colour === "stop" ? "stop" : `c${each.colour}`),
      width: each.hidden ? 0 : each.width || 1.5, dash: each.kind === "dash" ? [6, 4] : undefined,
      points: each.points ? { size: 4 } : { show: false }, spanGaps: false, paths: each.steps ? uPlot.paths.stepped({ align: 1 }) : undefined });
    const fade = (name) => { const hex = colour(name); return hex + "40"; };
    return {
      width, height: spec.height, legend: { show: false }, padding: [8, 34, 0, 0],
      cursor: { sync: { key: "time" }, drag: { x: false, y: false }, points: { size: 7 } },
      scales: { x: { time: true }, y: spec.log ? { distr: 3, log: 10, range: (u, low, high) => [0.1, Math.max(10 * spec.threshold, 10 * (high || 1))] }
        : { range: (u, low, high) => { const room = Math.max((high - low) * 0.08, 1e-9 + Math.abs(high) * 0.002); return [low - room, high + room]; } } },
      series: [{}, ...spec.series.map(line)],
      bands: spec.band ? [{ series: spec.band, fill: fade("c0") }] : [],
      axes: [{ ...axis, space: 80, size: 32, values: (u, all) => all.map((each) => clock(each) + (all[1] - all[0] < 1 ? `.${Math.floor(10 * (each % 1))}` : "")) },
        { ...axis, size: 58, ...(spec.log ? powers(axis) : {}), values: (u, all) => all.map((each) => each == null ? "" : spec.log ? `1e${Math.round(Math.log10(each))}` : digits(each)) }],
      hooks: {
        draw: [(u) => marks(u, spec)],
        setCursor: [(u) => values.forEach((each, i) => {
          const at = u.cursor.idx;
          each.textContent = at == null || spec.series[i].quiet ? "" : digits(u.data[i + 1][at], 4);
        })],
      },
    };
  };
  // On a logarithmic scale every second power of ten, without lines between them.
  const powers = ({ grid, ticks }) => {
    const filter = (u, all) => all.map((each) => each != null && Math.abs(Math.log10(each) % 2) < 1e-9 ? each : null);
    return { filter, grid: { ...grid, filter }, ticks: { ...ticks, filter } };
  };
  // Vertical lines at alarms and, where the scale has one, the threshold.
  const marks = (u, spec) => {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("stop");
    ctx.lineWidth = devicePixelRatio * 1.5;
    ctx.textAlign = "left";
    ctx.textBaseline = "bottom";
    ctx.font = `${13 * devicePixelRatio}px system-ui, sans-serif`;
    const segment = (x0, y0, x1, y1) => { ctx.beginPath(); ctx.moveTo(x0, y0); ctx.lineTo(x1, y1); ctx.stroke(); };
    if (spec.threshold) {
      const y = u.valToPos(spec.threshold, "y", true);
      ctx.setLineDash([7, 5]);
      segment(bbox.left, y, bbox.left + bbox.width, y);
      ctx.fillText("alarm", bbox.left + 6, y - 2);
      ctx.setLineDash([]);
    }
    for (const time of spec.alarms()) {
      if (time < u.scales.x.min || time > u.scales.x.max) continue;
      const x = u.valToPos(time, "x", true);
      segment(x, bbox.top, x, bbox.top + bbox.height);
      const half = 5 * devicePixelRatio;
      ctx.beginPath();
      ctx.moveTo(x - half, bbox.top); ctx.lineTo(x + half, bbox.top); ctx.lineTo(x, bbox.top + 1.6 * half); ctx.fill();
    }
    ctx.restore();
  };
  const column = (rows, i) => rows.map((row) => row[i]);
  const unit = ([name, of]) => of && of !== "1" ? `${name} in ${of}` : name;

  // Samples of a machine: all at first, then those that are new.
  const stream = (name) => {
    let held = null;
    return async () => {
      const since = held?.times.length ? `?after=${held.times.at(-1)}` : "";
      const got = await request(`/assets/${encodeURIComponent(name)}${since}`);
      const join = (key) => (held ? held[key].concat(got[key]) : got[key]).slice(-KEPT);
      const arrays = Object.fromEntries(["times", "measured", "mean", "low", "high", "commands", "evidence"].map((key) => [key, join(key)]));
      held = { ...got, ...arrays };
      return held;
    };
  };
  const pictures = (place, first, alarms) => {
    const errors = (held, key, i) => held[key].map((row, k) => row[i] == null || held.mean[k][i] == null ? null : row[i] - held.mean[k][i]);
    // Scores of trajectories have no other errors, and the prediction of a trajectory has no band.
    const scores = first.kind === "scores";
    const banded = first.kind !== "trajectory";
    const band = (label) => ({ hidden: true, quiet: true, kind: "area", colour: 0, label: banded ? label : null });
    const outputs = first.outputs.flatMap((each, i) => [chart({
      title: scores ? "What the healthy machine leaves unexplained of each trajectory, as a standard score" : unit(each), height: 260, alarms,
      about: `${each[0]}: measured, and ${banded ? "the 90 % band of " : ""}what the twin predicted`, band: banded && [2, 1],
      pick: (held) => [held.times, column(held.low, i), column(held.high, i), column(held.mean, i), column(held.measured, i)],
      series: [band(scores ? "90 % of healthy trajectories" : "90 % band of the prediction"), { hidden: true, quiet: true },
        { colour: 0, width: 3, label: scores ? "median of healthy ones" : "predicted" }, { colour: "ink", width: 1, points: banded, label: scores ? "score" : "measured" }],
    }), ...(scores ? [] : [chart({
      title: `${each[0]}: measured minus predicted${each[1] === "1" ? "" : ` in ${each[1]}`}`, height: 180, alarms, about: `errors of the prediction of ${each[0]}${banded ? ", and their 90 % band" : ""}`, band: banded && [2, 1],
      pick: (held) => [held.times, errors(held, "low", i), errors(held, "high", i), errors(held, "measured", i)],
      series: [band("90 % band"), { hidden: true, quiet: true },
        { colour: "ink", width: 1, points: banded, label: "error" }],
    })])]);
    const evidence = !first.evidence ? [] : [chart({
      title: "Evidence for a change", height: 200, alarms, log: true, threshold: first.arl, about: "evidence for a change over time, logarithmic, and the threshold of an alarm",
      pick: (held) => [held.times, held.evidence.map((each) => each == null ? null : Math.min(Math.max(each, 0.1), scores ? 1e6 * first.arl : Infinity))],
      series: [{ colour: 1, label: scores ? "evidence, at most a million times the threshold" : "evidence", width: 2, points: scores }],
    })];
    const commands = first.inputs.map((each, i) => chart({
      title: `Command ${unit(each)}`, height: 130, alarms, about: `command ${each[0]} over time`,
      pick: (held) => [held.times, column(held.commands, i)],
      series: [{ colour: 2, steps: true, label: "command" }],
    }));
    const all = [...outputs, ...evidence, ...commands];
    place.replaceChildren(...all.map((each) => each.element));
    return (held) => all.forEach((each) => each.set(each.spec.pick(held)));
  };

  // One machine.
  // An event lasts from its first alarm until the twin follows again.
  const course = (each) => each.ended ? `, until ${stamp(each.ended)} (${each.how})` : "";
  const WORDS = { alarm: (each) => `${each.output}: ${each.change}; ${cause(each)}${course(each)}`, void: () => "the promise does not apply any more: look for a fault first",
    remark: (each) => `Remark, for which nothing is promised: ${each.output}: ${each.change}`, event: (each) => each.text };
  const asset = (name) => {
    const next = stream(name);
    const head = h("div");
    const place = h("div");
    const log = h("ol", { class: "log" });
    let draw = null;
    let alarms = [];
    let shown = "";
    main.replaceChildren(h("h1", {}, name), head, place, h("h2", {}, "Events"), log);
    return async () => {
      const held = await next();
      if (held.times.length && !draw) draw = pictures(place, held, () => alarms);
      alarms = held.events.filter((each) => each.kind === "alarm").map((each) => each.time);
      const now = held.status;
      const last = now.alarm;
      const texts = {
        alarm: () => [`Event since ${stamp(last.time)}${course(last)}; ${last.output}: ${last.change}.`, ...(now.void_since ? [`The promise is VOID since ${stamp(now.void_since)}.`] : []), h("a", { href: to("alarm", last.sequence) }, `Cause: ${cause(last)}`)],
        void: () => [`The promise is VOID${now.void_since ? ` since ${stamp(now.void_since)}` : ""}: the machine is not the one of the calibration. What is seen are remarks, not alarms.`, "Look for a fault first: a calibration would take it for healthy. Only if the machine is healthy, recalibrate."],
        stopped: () => [`No new sample has arrived for ${span(now.idle)}.`, "Check the source of the samples and its connection."],
        outside: () => ["Commands leave the range of the calibration, where the twin extrapolates.", "Calibrate on records that have such commands."],
        impossible: () => [`Impossible values: ${now.impossible}.`, "They are not used. Check the sensor, its line and its converter."],
        rate: () => ["Samples arrive at another rate than the twin's.", now.rate],
        ok: () => ["What is measured agrees with the twin."],
      };
      head.replaceChildren(verdict(tone(now)[0], ...(texts[now.state] || texts.ok)()),
        facts(["Evidence for a change", now.evidence ? `${percent(now.evidence)} of the threshold` : "none", `alarm from ${digits(held.arl)} on`],
          ["Newest sample", stamp(now.time), Object.entries(now.counts).filter(([, n]) => n).map(([k, n]) => `${n} ${k}`).join(", ")],
          ["Twin", h("a", { href: to("versions", now.twin) }, now.twin), `version ${now.version}`],
          ["False events, promised", `1 in ${span(held.run_length / held.rate)}`, "at most, on average, by the model of the noise"],
          ...(held.tried ? [["False events, tried", `${held.tried.events} in ${span(held.tried.samples / held.rate)}`, `records left out in turn, which alone bounds the rate at 1 in ${span(held.tried.run_length / held.rate)} (exact 95 %)`]] : [])));
      if (draw) draw(held);
      const text = JSON.stringify(held.events);
      if (text !== shown && !log.contains(document.activeElement)) {
        shown = text;
        log.replaceChildren(...(held.events.length ? held.events.map((each) => {
          const words = (WORDS[each.kind] || WORDS.event)(each);
          return h("li", {}, h("time", {}, stamp(each.time)), h("span", {}, each.kind === "alarm"
            ? [h("a", { href: to("alarm", each.sequence) }, `Alarm: ${words}`), each.acknowledged ? " (acknowledged)" : ""] : words));
        }) : [h("li", {}, "No event yet.")]));
      }
    };
  };

  // Alarms.
  const alarmList = () => {
    const list = h("ol", { class: "log" });
    const older = h("div", { class: "buttons" });
    main.replaceChildren(h("h1", {}, "Alarms"), list, older);
    const more = async (next) => {
      const got = await request(`/alarms${next ? `?before=${next}` : ""}`);
      list.append(...got.alarms.map((each) => h("li", {}, h("time", {}, stamp(each.time)), h("span", {},
        h("a", { href: to("alarm", each.sequence) }, `${each.asset}: ${WORDS.alarm(each)}`), each.acknowledged ? " (acknowledged)" : ""))));
      older.replaceChildren(...(got.next ? [h("button", { type: "button", onclick: () => more(got.next) }, "Older alarms")] : []));
      if (!list.children.length) list.append(h("li", {}, "No alarm yet."));
    };
    let revision = null;
    return async () => {
      const { alarms: [newest] } = await request("/alarms?limit=1");
      const found = JSON.stringify(newest || null);
      if (found === revision || list.contains(document.activeElement)) return;
      revision = found;
      list.replaceChildren();
      await more();
    };
  };
  const alarm = (sequence) => {
    const about = h("div");
    const place = h("div");
    const answer = h("div");
    main.replaceChildren(about, place, answer);
    let shown = "";
    let form = null;
    let before = "";
    return async () => {
      const found = await request(`/alarms/${encodeURIComponent(sequence)}`);
      const text = JSON.stringify(found);
      if (text === shown) return;
      if (!shown) before = commandsBefore(found, await around(place, found));
      shown = text;
      const why = found.cause;
      about.replaceChildren(h("h1", {}, found.asset, ": ", why && why.probability >= 0.5 ? fault(why.name) : cause(found)),
        verdict("alarm", `Event since ${stamp(found.time)}${course(found)}; ${found.output}: ${found.change}. The twin of the healthy machine does not explain it.`,
          h("a", { href: to("asset", found.asset) }, "See the machine now")),
        facts(found.begin ? ["Trajectory", stamp(found.begin), `to ${clock(found.time)}`] : ["Began", why && why.onset[0] != null ? `${stamp(why.onset[0])}${why.earlier ? " or earlier" : ""}` : "–", why && why.onset[1] != null && `90 % interval ${clock(why.onset[1])} to ${clock(why.onset[2])}`],
          ...(found.begin ? [] : [["Size", ...(why ? interval(why.size, why.unit, why.limit) : ["–"])]]),
          ["Evidence", digits(found.evidence), `alarm from ${digits(found.arl)} on`],
          ["Version of the twin", `${found.version}`]),
        h("h2", {}, "What to check"),
        h("div", { class: "check" }, h("p", {}, why ? why.check : "The cause is being inferred from the samples before the alarm."),
          why && why.unknown > 0.5 ? h("p", {}, `Something besides is probable (${percent(why.unknown)}): a fault that is not in the list, or one that does more than its equation.`) : null),
        why ? probabilities(why, found.begin) : "", choice(found, before));
      if (found.acknowledged) {
        answer.replaceChildren(h("h2", {}, "Acknowledged"), h("p", {}, "by ", found.acknowledged.who, found.acknowledged.note ? `: ${found.acknowledged.note}` : ""));
      } else if (!form) {
        form = acknowledge(found);
        answer.replaceChildren(form);
      }
    };
  };
  const probabilities = (why, whole) => h("div", {}, h("h2", {}, "Probable causes"), h("table", { class: "bars" },
    h("caption", {}, whole ? "The share of each in the evidence; unknown is a change that no fault explains." : `If one of these is the cause. Probability of something besides: ${percent(why.unknown)}.`),
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Cause"), h("th", { scope: "col", class: "number" }, "Probability"), h("td"))),
    h("tbody", {}, Object.entries(why.probabilities).sort((a, b) => b[1] - a[1]).map(([name, value]) => {
      const part = h("i");
      fill(part, value);
      return h("tr", {}, h("th", { scope: "row" }, fault(name)), h("td", { class: "number" }, percent(value)), h("td", { "aria-hidden": "true" }, h("span", { class: "meter" }, part)));
    }))));
  // What speaks for a fault, and what for a new normal, is stated before anybody recalibrates.
  const choice = (found, before) => h("section", { class: "card" }, h("h2", {}, "Fault or new normal?"), h("ul", {},
    h("li", {}, found.cause ? `Known causes: ${cause(found)} explains it best; probability of something besides them: ${percent(found.cause.unknown)}.` : "The cause is not known yet."),
    h("li", {}, found.ended ? `It ended at ${stamp(found.ended)}: ${found.how}.` : found.begin ? "Look at the trajectories that follow." : "It lasts."),
    before ? h("li", {}, before) : null),
  h("p", {}, "A fault: repair it. A calibration with its samples would take it for healthy. A new normal: ", h("code", {}, `retwin monitor recalibrate STORE --asset '${found.asset}' --new-normal NAME`), ", with your name, which the version keeps."));
  const commandsBefore = (found, held) => {
    const rows = found.begin || !held ? [] : held.commands.filter((_, k) => held.times[k] < found.time);
    if (!rows.length) return "";
    const ranges = held.inputs.map((each, i) => {
      const values = column(rows, i).filter((value) => value != null);
      const [low, high] = [Math.min(...values), Math.max(...values)].map((value) => Number(value.toPrecision(5)));
      return !values.length ? `${each[0]} not known` : `${unit(each)} ${low === high ? `constant at ${low}` : `${low} to ${high}`}`;
    });
    return `Commands in the ${span(found.time - held.times[0])} before it: ${ranges.join("; ")}.`;
  };
  const acknowledge = (found) => {
    const who = h("input", { autocomplete: "name", maxlength: 200 });
    const what = h("select", {}, ["", "a fault", "a new normal"].map((each) => h("option", { value: each }, each || "not known yet")));
    const note = h("textarea", { maxlength: 1900 });
    return h("section", { class: "card" }, h("h2", {}, "Acknowledge"), h("p", { class: "quiet" }, "It is for this alarm and for earlier ones of this machine."), h("label", {}, "Your name", who), h("label", {}, "What it is", what), h("label", {}, "What was found", note),
      h("p", { class: "buttons" }, action("Acknowledge", `/alarms/${found.sequence}/acknowledge`, () => ({ who: who.value, note: [what.value, note.value].filter(Boolean).join(": ") }), { first: true })));
  };
  const around = async (place, found) => {
    const held = await request(`/alarms/${found.sequence}/samples`).catch(() => null);
    if (!held?.times.length || !place.isConnected) return null;
    const box = h("div");
    place.replaceChildren(h("h2", {}, found.begin ? "The trajectory, beside the twin of the healthy machine" : "Samples around the alarm"), box);
    pictures(box, held, () => found.begin ? [] : [found.time])(held);
    return held;
  };

  // Versions of a twin.
  const versions = (twin) => {
    const path = `/versions/${encodeURIComponent(twin)}`;
    const list = h("div");
    let shown = "";
    main.replaceChildren(h("h1", {}, `Versions of ${twin}`), h("p", { class: "quiet" }, "A version is proposed, then predicts in the shadow of the active one, and is promoted if it predicts better and keeps the promise."), list);
    return async () => {
      const { versions: all } = await request(path);
      const text = JSON.stringify(all);
      if (text === shown) return;
      shown = text;
      const retired = all.filter((each) => each.state === "retired").length;
      list.replaceChildren(...[...all].reverse().map((each) => version(path, each, retired)));
    };
  };
  const STATES = { active: ["ok", "Active"], shadow: ["wait", "Shadow"], proposed: ["wait", "Proposed"], retired: ["", "Retired"], rejected: ["", "Rejected"] };
  const version = (path, each, retired) => {
    const [kind, name] = STATES[each.state];
    const step = (verb, title, options) => action(title, `${path}/${each.number}/${verb}`, { reason: "on the page" }, options);
    const compared = h("div", { "aria-live": "polite" });
    const buttons = h("div", { class: "buttons" });
    if (each.state === "proposed") buttons.append(...step("shadow", "Make it the shadow", { first: true }), ...step("reject", "Reject"));
    if (each.state === "active" && retired) buttons.append(...action("Roll back to the version before", `${path}/rollback`, { reason: "on the page" }));
    if (each.state === "shadow") {
      compared.append(h("p", { class: "quiet" }, "Comparing both on what is stored …"));
      request(`${path}/${each.number}/comparison`).then((found) => {
        compared.replaceChildren(...comparison(found));
        buttons.prepend(...step("promote", "Promote", { first: true, disabled: !found.better }));
      }, (error) => compared.replaceChildren(h("p", { class: "error" }, error.message)));
      buttons.append(...step("reject", "Reject"));
    }
    return h("section", { class: "card" }, h("h2", {}, `Version ${each.number} `, h("span", { class: `badge ${kind}` }, name)),
      h("p", {}, each.reason), h("p", { class: "quiet" }, `SHA-256 ${each.digest.slice(0, 16)}…${each.reference ? ", the reference: the first active version, which is never changed" : ""}`), compared, buttons);
  };
  const comparison = (found) => {
    const reach = Math.max(Math.abs(found.low), Math.abs(found.high)) * 1.15 || 1;
    const at = (value) => `${50 + 50 * value / reach}%`;
    const bar = h("i", { class: "bar" });
    bar.style.left = at(found.low);
    bar.style.right = `${50 - 50 * found.high / reach}%`;
    const dot = h("i", { class: "at" });
    dot.style.left = at(found.difference);
    const zero = h("i", { class: "zero" });
    zero.style.left = "50%";
    const label = h("span", {}, "0");
    label.style.left = "50%";
    const kind = found.low > 0 ? "ok" : found.high < 0 ? "alarm" : "wait";
    return [h("p", {}, found.low > 0 ? "It predicts better than the active version." : found.high < 0 ? "It predicts worse than the active version." : "Whether it predicts better is undecided."),
      h("span", { class: `forest ${kind}`, "aria-hidden": "true" }, zero, bar, dot, label),
      h("p", {}, `CRPS is lower by ${digits(found.difference)} (95 % interval ${digits(found.low)} to ${digits(found.high)}): ${digits(found.old_crps)} before, ${digits(found.new_crps)} with this version.`),
      h("p", {}, `It raised ${counted(found.alarms, "alarm")} in ${found.samples} healthy ${found.unit}, where ${digits(found.promised)} are promised at most: ${found.passed ? "that agrees with the promise" : "too many for the promise"}.`),
      found.reference?.alarms ? h("p", { class: "error" }, `The first active version, which is never changed, raised ${counted(found.reference.alarms, "alarm")} in the same ${found.unit}: the machine differs from the one that it was calibrated on. Check whether that is a fault that grows slowly, which this version would learn.`) : ""];
  };

  // The address selects the page; the server's events, and at least every ten seconds, renew it.
  const ROUTES = { "": fleet, asset, alarms: alarmList, alarm, versions };
  let show = async () => {};
  let busy = false;
  let again = false;
  let wake = () => {};
  let events = null;
  let twins = "";
  const pages = async () => {
    const { assets, emulated } = await request("/assets");
    $(".emulated").hidden = !emulated;
    const found = [...new Set(assets.map((each) => each.twin))].sort().slice(0, 20);
    if (twins === JSON.stringify(found)) return;
    twins = JSON.stringify(found);
    const links = [["Machines", "#/"], ["Alarms", to("alarms")], ...found.map((each) => [`Versions of ${each}`, to("versions", each)])];
    $("#pages").replaceChildren(...links.map(([text, href]) => h("li", {}, h("a", { href }, text))));
    here();
  };
  const here = () => document.querySelectorAll("#pages a").forEach((each) => {
    if (each.getAttribute("href") === (location.hash || "#/")) each.setAttribute("aria-current", "page");
    else each.removeAttribute("aria-current");
  });
  const linked = (kind, text) => {
    if ($("#link").className === kind) return;
    $("#link").className = kind;
    $("#link .text").textContent = text;
  };
  const refresh = async () => {
    again = true;
    if (busy) return;
    busy = true;
    while (again) {
      again = false;
      const shown = show;
      try {
        await shown();
        if (events?.readyState === EventSource.OPEN) linked("live", "live");
      } catch (error) {
        if (shown !== show) continue;
        if (error.status) main.replaceChildren(h("h1", {}, "Not found"), h("p", { class: "error" }, error.message), h("a", { href: "#/" }, "To all machines"));
        if (error.status) show = async () => {};
        else linked("lost", "no connection");
      }
      if (shown === show) await new Promise((resolve) => { wake = resolve; setTimeout(resolve, INTERVAL); });
    }
    busy = false;
  };
  const navigate = (moved) => {
    forget();
    let parts;
    try {
      parts = location.hash.replace(/^#\/?/, "").split("/").map(decodeURIComponent);
    } catch {
      parts = [""];
    }
    const route = Object.hasOwn(ROUTES, parts[0]) ? ROUTES[parts[0]] : fleet;
    main.replaceChildren();
    show = route(parts[1] ?? "");
    document.title = `${parts[1] || parts[0] || "machines"} · retwin monitor`;
    here();
    if (moved) { main.focus({ preventScroll: true }); scrollTo(0, 0); }
    wake();
    refresh();
  };
  const listen = () => {
    events = new EventSource("/events");
    events.onopen = () => { linked("live", "live"); refresh(); pages().catch(() => {}); };
    events.onmessage = () => { linked("live", "live"); if (!document.hidden) refresh(); };
    events.onerror = () => {
      linked("lost", "no connection");
      if (events.readyState === EventSource.CLOSED) setTimeout(listen, 3000);
    };
  };
  listen();
  setInterval(() => { if (!document.hidden) { refresh(); pages().catch(() => {}); } }, 10000);
  document.addEventListener("visibilitychange", () => document.hidden || refresh());
  addEventListener("hashchange", () => navigate(true));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach((each) => each.draw()));
  navigate(false);
})();
