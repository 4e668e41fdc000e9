// Probabilities of effects by axis, and the evidence of each behind its bar.

const percentOf = (share) => (share > 0 && share < 0.01 ? "< 1 %" : share > 0.99 ? "> 99 %" : `${Math.round(100 * share)} %`);

function buildEffects() {
  const host = document.getElementById("effect-list");
  if (!content.verdicts.length) {
    host.append(make("p", {}, "No effects have been compared yet: run bampipe diagnose."));
  }
  for (const verdict of content.verdicts) host.append(verdictOf(verdict));
}

/** The verdict on one axis, a bar for each effect that is probable at all. */
function verdictOf({ model, axis, sentence, unknown, effects }) {
  const place = make("div", { class: "evidence", role: "status" });
  const bars = effects.map((effect) => bar(effect.name, effect.probability, place, () => evidenceOf(effect, model, axis)));
  if (unknown > 0) {
    bars.push(bar("something unknown", unknown, place, () => [make("p", {}, `An effect that the library does not have: ${percentOf(unknown)}. The residual maps of ${axis} show its shape.`), ways(axis)]));
  }
  return make(
    "div",
    { class: "verdict" },
    make("h3", {}, content.models.length > 1 ? `${axis}, ${labelOf(model)}` : axis),
    make("p", { class: "remark" }, sentence),
    ...bars,
    bars.length ? place : null,
  );
}

/** A button as long as a probability; it opens and closes its evidence. */
function bar(name, share, place, evidence) {
  const fill = make("span", { class: "fill", style: `width: ${100 * share}%` });
  const button = make("button", { type: "button", class: "bar", "aria-expanded": "false" }, fill, make("span", {}, name), make("span", { class: "share" }, percentOf(share)));
  button.addEventListener("click", () => {
    const open = button.getAttribute("aria-expanded") === "true";
    button.parentElement.querySelectorAll(".bar").forEach((one) => one.setAttribute("aria-expanded", "false"));
    button.setAttribute("aria-expanded", String(!open));
    place.replaceChildren(...(open ? [] : evidence()));
  });
  return button;
}

/** Evidence for an effect: errors without and with it, chance, sets that contain it, its signature. */
function evidenceOf({ name, ranked, said, sets }, model, axis) {
  const found = [make("p", {}, make("code", {}, name), said ? `: ${said.summary}` : "")];
  if (ranked) {
    const fall = 100 * (1 - ranked.held_out_rmse_after / ranked.held_out_rmse_before);
    const numbers = Object.entries(ranked.parameters).map(([key, value]) => `${key} = ${format(value)}`);
    found.push(
      make("p", {}, `Held-out error of ${axis} ${format(ranked.held_out_rmse_before, 3)} ${ranked.unit} without it, ${format(ranked.held_out_rmse_after, 3)} ${ranked.unit} with it (${format(fall, 2)} % less); gain ${format(ranked.score, 3)} nats. Replicates of the model give some candidate such a gain with probability ${format(ranked.p_value, 2)}.`),
    );
    if (numbers.length) found.push(make("p", {}, `Fitted: ${numbers.join(", ")}.`));
    if (ranked.indistinguishable_from.length) found.push(make("p", {}, `These trials do not distinguish it from ${ranked.indistinguishable_from.join(", ")}.`));
  }
  if (said) {
    found.push(make("p", {}, `Signature: ${said.looks_like}.`));
    if (said.on_the_machine) found.push(make("p", {}, `On the machine: ${said.on_the_machine}.`));
  }
  if (sets.length) {
    found.push(make("p", {}, "Sets that contain it:"), make("ul", {}, ...sets.map((one) => make("li", {}, `${one.effects}: ${percentOf(one.probability)}`))));
  }
  return [...found, ways(axis, model)];
}

/** Ways from the evidence to the samples. */
function ways(axis, model = null) {
  const go = (text, target, act) =>
    make("button", { type: "button", onclick: async () => {
      await act();
      document.getElementById(target).scrollIntoView();
    } }, text);
  const window = content.windows.find((one) => one.axis === axis && (model === null || one.model === model));
  const traceable = find({ role: "measured", axis }).length > 0;
  return make(
    "p",
    { class: "choices" },
    traceable ? go(`Residual maps of ${axis}`, "maps", () => setAxis(axis)) : null,
    traceable && window ? go("Worst window in the traces", "traces", () => showWindow(window)) : null,
  );
}
