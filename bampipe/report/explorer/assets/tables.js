// Tables that can be sorted and searched.

/** {title, note, head, rows, texts?, drawn?: {head, cells}, csv?, buttons?} as an element; columns
    without a word in any row are left out. */
function tableOf({ title, note = "", head: heading, rows: all, texts: words = null, drawn = null, csv = null, buttons = null }) {
  const kept = heading.map((_, k) => k).filter((k) => k === 0 || all.some((row) => row[k] !== null && row[k] !== ""));
  const [head, ...rows] = [heading, ...all].map((row) => kept.map((k) => row[k]));
  const texts = words?.map((row) => kept.map((k) => row[k]));
  const numeric = head.map((_, k) => rows.some((row) => typeof row[k] === "number") && rows.every((row) => row[k] === null || typeof row[k] === "number"));
  const said = (row, k) => texts?.[row][k] ?? (typeof rows[row][k] === "number" ? format(rows[row][k]) : (rows[row][k] ?? "–"));
  const lines = rows.map((_, row) => {
    const cells = head.map((__, k) => {
      const inside = k === 0 && buttons ? make("button", { type: "button", onclick: () => buttons(row) }, said(row, k)) : said(row, k);
      return make("td", { class: numeric[k] ? "n" : null }, inside);
    });
    if (drawn) cells.push(make("td", {}, drawn.cells[row]));
    return make("tr", {}, ...cells);
  });
  const body = make("tbody", {}, ...lines);
  const heads = head.map((text, k) => make("th", { scope: "col", class: numeric[k] ? "n" : null }, make("button", { type: "button", onclick: () => sort(k) }, text)));
  if (drawn) heads.push(make("th", { scope: "col" }, drawn.head));

  function sort(k) {
    const rising = heads[k].getAttribute("aria-sort") !== "ascending";
    heads.forEach((one) => one.removeAttribute("aria-sort"));
    heads[k].setAttribute("aria-sort", rising ? "ascending" : "descending");
    const order = rows.map((_, row) => row).sort((p, q) => {
      const [a, b] = [rows[p][k], rows[q][k]];
      if (a === b) return p - q;
      if (a === null) return 1;
      if (b === null) return -1;
      const less = numeric[k] ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true });
      return rising ? less : -less;
    });
    body.append(...order.map((row) => lines[row]));
  }

  const search = make("input", { type: "search", placeholder: "Search", "aria-label": `Search in ${title}` });
  search.addEventListener("input", () => {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    lines.forEach((line) => (line.hidden = !words.every((word) => line.textContent.toLowerCase().includes(word))));
  });
  const save = make("button", { type: "button", "aria-label": `${title}: CSV`, onclick: () => download(fileName(title, "csv"), "text/csv", csv ? csvOf(csv.head, csv.rows) : csvOf(head, rows)) }, "CSV");
  return make(
    "div",
    {},
    make("div", { class: "tablehead" }, make("h3", {}, title), rows.length > 5 ? search : null, make("span", { class: "tools" }, save)),
    note ? make("p", { class: "remark" }, note) : null,
    make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": title }, make("table", {}, make("thead", {}, make("tr", {}, ...heads)), body)),
  );
}

function buildTables() {
  const host = document.getElementById("table-list");
  if (content.windows.length) {
    host.append(
      tableOf({
        title: "Worst windows",
        note: "Where the prediction fails most. The button shows the window in the traces.",
        head: ["Window", "Axis", "Version", "From (s)", "To (s)", "RMSE", "Unit", "Doing"],
        rows: content.windows.map((one) => [one.trial_id, one.axis, labelOf(one.model), one.t_start, one.t_end, one.rmse, one.unit, one.doing]),
        buttons: (row) => {
          showWindow(content.windows[row]);
          document.getElementById("traces").scrollIntoView();
        },
      }),
    );
  }
  for (const table of content.tables) host.append(tableOf(table));
  for (const { model, ranking } of newestFirst.filter((one) => one.ranking.length)) {
    host.append(
      tableOf({
        title: `Candidate effects, ${labelOf(model)}`,
        note: "Held-out error without and with each effect; the one that was not fitted is scaled by the weighted misfit. p: probability that replicates give any candidate as large a gain.",
        head: ["Effect", "Axis", "Without", "With", "Unit", "Probability", "p", "Indistinguishable from"],
        rows: ranking.map((one) => [one.effect, one.axis, one.held_out_rmse_before, one.held_out_rmse_after, unitOf(one.unit), one.probability, one.p_value, one.indistinguishable_from.join(", ")]),
      }),
    );
  }
}
