// The cost of a false-alarm rate on the reader's own machine; thresholds are looked up.
(() => {
  "use strict";
  const content = JSON.parse(document.getElementById("calculator-content").textContent);
  const at = (name) => document.getElementById("calculate-" + name);
  const fields = ["source", "rate", "faulty", "missed"];
  const terms = ["alarm threshold", "its false alarms, 95 % range", "faults detected", "detected at the rate, 95 % interval", "of these, correct class", "most often missed", "most often confused"];

  // False alarms, missed faults and their total cost among `content.trajectories`; rate 0 means no alarm at all.
  const costs = (decision, faulty, missed) => {
    const alarms = decision.rate * content.trajectories * (1 - faulty);
    const unseen = (1 - decision.detected) * content.trajectories * faulty;
    return { alarms, unseen, cost: alarms + missed * unseen };
  };
  const percent = (rate) => `${(100 * rate).toFixed(1)} %`;
  const fact = ([term, text]) => {
    const made = document.createElement("div");
    made.append(
      Object.assign(document.createElement("dt"), { textContent: term }),
      Object.assign(document.createElement("dd"), { textContent: text }));
    return made;
  };

  const update = () => {
    const source = content.sources[Number(at("source").value)];
    const [rate, faulty, missed] = ["rate", "faulty", "missed"].map((name) => Number(at(name).value));
    if (fields.some((name) => !at(name).value || !at(name).validity.valid)) {
      at("result").replaceChildren();
      at("best").textContent = "Rates lie between 0 and 99 %, shares between 0 and 100 %, costs at 0 or above.";
      return;
    }
    const silent = { rate: 0, detected: 0 };
    const among = (decisions) => decisions.map((each) => [each, costs(each, faulty / 100, missed)]);
    // The last rate that does not exceed the requested one; the margin allows for rounding.
    const allowed = source.decisions.filter((each) => each.rate <= rate / 100 + 1e-9);
    const decision = allowed[allowed.length - 1];
    const best = among([silent, ...source.decisions]).reduce((a, b) => (b[1].cost < a[1].cost ? b : a));
    if (decision) {
      const { alarms, unseen, cost } = costs(decision, faulty / 100, missed);
      at("result").replaceChildren(...[
        ...terms.map((term, i) => [term, decision.texts[i]]),
        [`of ${content.trajectories}: false alarms`, alarms.toFixed(0)],
        [`of ${content.trajectories}: missed faults`, unseen.toFixed(1)],
        ["cost, in false alarms", cost.toFixed(0)],
      ].map(fact));
    } else {
      at("result").replaceChildren();
    }
    const none = "A false-alarm rate of 0 % cannot be promised by any number of healthy trajectories. ";
    const few = `${content.healthy} healthy trajectories cannot promise ${rate} %: it requires at least ${Math.ceil(100 / rate) - 1} of them. `;
    const cheapest = best[0].rate ? `a false-alarm rate of ${percent(best[0].rate)}` : "never to raise an alarm";
    at("best").textContent = (decision ? "" : rate ? few : none) +
      `The lowest cost with these settings: ${cheapest} (cost ${best[1].cost.toFixed(0)}).`;
  };

  at("source").append(...content.sources.map((source, i) => new Option(source.name, String(i))));
  at("source").value = String(content.first);
  // Rounded up, so that the rate is the one that the page chose.
  at("rate").value = String(content.rate === null ? 20 : Math.ceil(10 * content.rate - 1e-6) / 10);
  at("faulty").value = String(content.faulty);
  at("missed").value = String(content.missed);
  fields.forEach((name) => at(name).addEventListener("input", update));
  update();
})();
