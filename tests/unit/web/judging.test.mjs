// Laws of the line that says that a verdict is waited for: what it is at, then what came of it, never of the verdict before.

import assert from "node:assert/strict";
import { test } from "node:test";

const { JudgingNote, outcome, underWay } = await import("../../../scanner_service/web/static/judging_note.js");

const judging = (step, seconds) => ({ why: "scan_ended", step, share: 0.4, for_s: seconds });

test("a verdict under way says why and which step, and for how long once that says something", () => {
  assert.equal(underWay(judging("reading the map", 0.4)), "Judging the scan: reading the map…");
  assert.equal(underWay({ ...judging("looking for regions", 2.6), why: "asked_anew" }), "Judging by what is asked for now: looking for regions… 3 s");
  assert.equal(underWay({ ...judging("x", 0), why: "of another version" }), "Judging: x…");
});

test("what came of it counts regions, and leaves out what is not known", () => {
  assert.match(outcome({ coverage: 0.5 }, [1]), /^Judged: 1 region needs another scan, coverage 50\.0.%\.$/);
  assert.equal(outcome({ coverage: null }, []), "Judged: no region needs another scan.");
  assert.equal(outcome({ coverage: null }, null), "Judged.");
});

function page(context) {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const places = Object.fromEntries(["judging", "judging-text", "judging-share"].map((id) => [id, { dataset: {}, textContent: "", hidden: true }]));
  globalThis.document = { getElementById: (id) => places[id] };
  return { places, said: () => (places.judging.hidden ? "" : places["judging-text"].textContent) };
}

test("the line never counts the regions of the verdict before", (context) => {
  const { places, said } = page(context);
  let regions = [1, 2, 3];
  const note = new JudgingNote(() => regions);
  note.status({ judging: null, coverage: 0.2 });
  assert.equal(said(), "", "nobody waited");
  note.status({ judging: judging("reading the map", 0) });
  assert.match(said(), /^Judging/);
  assert.equal(places["judging-share"].value, 0.4);
  note.status({ judging: null, coverage: 0.9 });
  assert.match(said(), /^Judged: coverage 90/);
  regions = [1];
  note.status({ judging: null, coverage: 0.9 });
  assert.match(said(), /^Judged: 1 region needs/);
  assert.equal(places["judging-share"].hidden, true);
  context.mock.timers.tick(30_000);
  assert.equal(said(), "", "it goes when it was read");
});

test("what was asked for on this page is judged when it is answered, whatever a status says before or never says", (context) => {
  const { said } = page(context);
  let regions = [1, 2, 3];
  const note = new JudgingNote(() => regions);
  note.ask();
  note.status({ judging: null, coverage: 0.2 }); // of before the request
  assert.match(said(), /^Judging by what is asked for now/);
  regions = [4, 5]; // a verdict that is told before any status of it
  note.status({ judging: judging("x", 0), coverage: 0.2 });
  note.status({ judging: null, coverage: 0.7 });
  assert.match(said(), /^Judging/, "the answer is not there");
  note.answered();
  assert.match(said(), /^Judged: 2 regions need another scan, coverage 70/);
  note.ask();
  note.open();
  note.status({ judging: null, coverage: 0.7 });
  assert.equal(said(), "", "it was refused");
});

test("an outcome whose regions come when it has gone is shown once more", (context) => {
  const { said } = page(context);
  let regions = [1];
  const note = new JudgingNote(() => regions);
  note.status({ judging: judging("x", 0) });
  note.status({ judging: null, coverage: 0.5 });
  context.mock.timers.tick(30_000);
  note.status({ judging: null, coverage: 0.5 });
  assert.equal(said(), "");
  regions = [];
  note.status({ judging: null, coverage: 0.5 });
  assert.match(said(), /^Judged: no region needs another scan/);
  regions = [7];
  note.status({ judging: null, coverage: 0.6 });
  assert.match(said(), /no region/, "a later verdict is another matter");
  context.mock.timers.tick(30_000);
  assert.equal(said(), "");
});
