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

test("the line never counts the regions of the verdict before", (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const places = Object.fromEntries(["judging", "judging-text", "judging-share"].map((id) => [id, { dataset: {}, textContent: "", hidden: true }]));
  globalThis.document = { getElementById: (id) => places[id] };
  const said = () => (places.judging.hidden ? "" : places["judging-text"].textContent);
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
