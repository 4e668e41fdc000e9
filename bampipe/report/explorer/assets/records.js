// The stored records of each model, as figures and tables read them.

const unitOf = (text) => text.replace(/[.*]/g, "·").replaceAll("^", "").replace(/(?<=[A-Za-z])[23]/g, (digit) => ({ 2: "²", 3: "³" })[digit]);
const joined = (names) => (names.length < 2 ? names.join("") : `${names.slice(0, -1).join(", ")} and ${names.at(-1)}`);
const diagnosed = content.models.flatMap(({ diagnose, prefix }, model) => (diagnose ? [{ model, prefix, ...diagnose }] : []));
const newestFirst = [...diagnosed].reverse();

content.maps = diagnosed.flatMap(({ model, maps: byAxis }) =>
  Object.entries(byAxis).flatMap(([axis, found]) => Object.entries(found).map(([variable, map]) => ({ ...map, model, axis, variable, unit: unitOf(map.unit) }))),
);

content.windows = newestFirst.flatMap(({ model, prefix, worst_windows }) =>
  worst_windows.map((one) => ({ ...one, model, trial_id: prefix + one.trial_id, unit: unitOf(one.unit), doing: one.doing.replace(/-(?=[\d.])/g, "−") })),
);

content.verdicts = newestFirst.flatMap(({ model, axes, ...rest }) =>
  content.axes
    .filter(({ name }) => axes[name])
    .map(({ name: axis }) => {
      const { sentence, unknown, probabilities } = axes[axis];
      const probable = Object.entries(probabilities).filter(([, share]) => share > 0).sort((a, b) => b[1] - a[1]);
      return { model, axis, sentence, unknown, effects: probable.map(([name, probability]) => ({ name, probability, ...evidenceFor(name, axis, rest) })) };
    }),
);

/** What a diagnosis says of an effect: its rank on an axis, the text of its file, sets that hold it. */
function evidenceFor(name, axis, { ranking, sets, descriptions = {} }) {
  const ranked = ranking.find((one) => one.effect === name && one.axis === axis);
  const holding = sets.filter((one) => one.effects.includes(name));
  return {
    ranked: ranked && { ...ranked, unit: unitOf(ranked.unit) },
    said: descriptions[name.split(":")[0]],
    sets: holding.map(({ effects, unknown, probability }) => ({ effects: joined([...effects, ...(unknown ? [`something unknown on ${unknown}`] : [])]), probability })),
  };
}

content.ladder = {};
for (const { name } of content.axes) {
  const rungs = content.models.map(({ validate }) => validate?.axes[name]);
  if (rungs.some(Boolean)) content.ladder[name] = rungs.map((one) => ({ error: one?.held_out_rmse ?? null, floor: one?.noise_floor ?? null }));
}

content.parameters = content.parameters.map((name) => {
  const values = content.models.map(({ identify }) => identify?.parameters[name] ?? null);
  return { name, unit: unitOf(values.find(Boolean).unit), values };
});

content.correlations = content.models.flatMap(({ identify }, model) => {
  const { names, matrix } = identify?.covariance ?? { names: [] };
  const shareOf = (value, i, k) => value / Math.sqrt(matrix[i][i] * matrix[k][k]);
  const shares = names.map((_, i) => matrix[i].map((value, k) => shareOf(value, i, k)).map((share) => (Number.isFinite(share) ? share : null)));
  return names.length ? [{ model, names, matrix: shares, blocks: identify.blocks ?? null }] : [];
});
