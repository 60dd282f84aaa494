// Laws of the requirement form: what is told asks for itself, presets are known again, refusals find their fields.

import assert from "node:assert/strict";
import { test } from "node:test";

const { inWords, presetOf, reached, refusalsByField, requestOf, textsOf } = await import("../../../scanner_service/web/static/requirement_form.js");
const { fate, foretold, loopSaid, outOfReach, planning, sameButton, served } = await import("../../../scanner_service/web/static/passes_panel.js");
const { opening } = await import("../../../scanner_service/web/static/numbers.js");

const STANDARD = { preset: "standard", density_per_mm2: null, density_share: 0.5, line_spacing_mm: null, chord_error_mm: null, finest_line_spacing_mm: 0.05, incidence_deg: null, noise_mm: null, coverage_share: 0.95, interest: null };
const FINE = { ...STANDARD, preset: "fine", line_spacing_mm: 0.15, chord_error_mm: 0.005, incidence_deg: 60, coverage_share: 0.99 };
const PRESETS = { standard: STANDARD, fine: FINE };
const asked = (told) => Object.fromEntries(Object.entries(told).filter(([name, value]) => name !== "preset" && value !== null));

test("what the service tells fills the form, and the form asks for just that", () => {
  const box = { low_mm: [-1.5, 0, 2], high_mm: [20, 30.25, 40] };
  for (const told of [STANDARD, FINE, { ...FINE, density_per_mm2: 12.5, noise_mm: 0.0123, interest: box }]) {
    assert.deepEqual(requestOf(textsOf(told)), { body: asked(told), refused: {} });
  }
  for (let share = 1; share <= 100; share += 1) assert.equal(requestOf(textsOf({ ...STANDARD, coverage_share: share / 100 })).body.coverage_share, share / 100);
});

test("a preset is known by its values, whatever its fields were filled by", () => {
  for (const [name, told] of Object.entries(PRESETS)) assert.equal(presetOf(requestOf(textsOf(told)).body, PRESETS), name);
  assert.equal(presetOf(requestOf({ ...textsOf(FINE), noise_mm: "0.02" }).body, PRESETS), null);
  assert.equal(presetOf(requestOf({ ...textsOf(FINE), line_spacing_mm: "" }).body, PRESETS), null);
});

test("what is no number, and a box that is not whole, is refused beside its field; nothing is guessed", () => {
  const { body, refused } = requestOf({ ...textsOf(STANDARD), noise_mm: "much", line_spacing_mm: "0,25", "interest.low_mm.x": "3" });
  assert.deepEqual(Object.keys(refused), ["noise_mm", "interest"]);
  assert.equal(body.line_spacing_mm, 0.25);
  assert.ok(!("interest" in body) && !("noise_mm" in body));
});

test("a refusal stands beside the fields that it names, or below the form", () => {
  const message = "noise_mm asks for at most 0.005 mm";
  assert.deepEqual(refusalsByField({ message, body: { fields: ["noise_mm"] } }), { noise_mm: message });
  assert.deepEqual(refusalsByField({ message, body: { errors: [{ at: "body.interest.low_mm.0", message: "a" }, { at: "body.density_per_mm2", message: "b" }] } }), { interest: "a", density_per_mm2: "b" });
  for (const body of [null, {}, { fields: ["preset"] }]) assert.deepEqual(refusalsByField({ message, body }), { "": message });
});

test("what is asked for, and whether it is reached, reads in one line", () => {
  assert.equal(inWords(STANDARD), "standard: 50 % of the lines' density · coverage 95 %");
  assert.equal(inWords({ ...FINE, preset: null, density_per_mm2: 12 }), "12 points/mm² · lines 0.15 mm · chord 0.005 mm · incidence 60° · coverage 99 %");
  assert.equal(reached({ requirement: STANDARD, coverage: null, holds: null }), "not known yet");
  assert.match(reached({ requirement: STANDARD, coverage: 0.97, holds: true }), /^holds: 97\.0/);
  assert.match(reached({ requirement: STANDARD, coverage: 0.26, holds: false }), /^26\.0.% of 95\.0.%$/);
  assert.equal(reached({ requirement: { ...STANDARD, coverage_share: null }, coverage: 0.9, holds: null }), "");
});

test("messages begin with a capital, names are left as they are", () => {
  assert.equal(opening("the scanner is gone"), "The scanner is gone");
  assert.equal(opening("good; 13 mm to go"), "Good; 13 mm to go");
  assert.equal(opening("first turn the part"), "First turn the part");
  for (const named of ["bun000.ply has no points", "noise_mm asks for less", "part: it cannot be read", "ttyUSB0 is gone", "3 sessions are open", ""]) assert.equal(opening(named), named);
});

test("a pass says what it promises, what it explores, and between what both will lie", () => {
  const pass = { promised_mm2: 12, promised_between_mm2: [8.04, 15], explores_mm2: 30, explores_between_mm2: [0, 81.3] };
  assert.equal(foretold(pass), "promises 12 (8 to 15), explores for 30 (0 to 81) mm²");
  assert.equal(foretold({ ...pass, explores_mm2: 0.1 }), "promises 12 (8 to 15) mm²");
  const hardly = foretold({ ...pass, explores_mm2: 31.1, explores_between_mm2: [3.6e-15, 85] });
  assert.equal(hardly, "promises 12 (8 to 15), explores for 31.1 (0 to 85) mm²");
  assert.equal(foretold({ ...pass, promised_mm2: 0 }), "explores for 30 (0 to 81) mm²");
});

test("a pass names its regions as the list does, an order what became of it", () => {
  const serves = [{ region: 7 }, { region: 3 }, { region: null }];
  assert.equal(served({ serves }), "regions 7, 3 and unseen surface");
  assert.equal(served({ serves: serves.slice(0, 1) }), "region 7");
  assert.equal(fate({ status: "accepted", message: null, outcome: null, reached_end: false }), "");
  assert.equal(fate({ status: "done", message: null, outcome: { promised_mm2: 12, reached_mm2: 4 }, reached_end: false }), "promised 12, reached 4 mm²; ended before its end");
  const outcome = { promised_mm2: 12, promised_between_mm2: [8.04, 15], reached_mm2: 9, expected_mm2: 30, expected_between_mm2: [0, 81.3], found_mm2: 55 };
  assert.equal(fate({ status: "done", message: null, outcome, reached_end: true }), "promised 12 (8 to 15), reached 9 mm²; explored: 55 found, 30 (0 to 81) mm² expected");
  assert.equal(fate({ status: "done", message: null, outcome: { ...outcome, promised_mm2: 0 }, reached_end: true }), "explored: 55 found, 30 (0 to 81) mm² expected");
  assert.equal(fate({ status: "failed", message: "the port is gone", outcome: null, reached_end: false }), "the port is gone");
  for (const status of ["doubted", "withdrawn"]) assert.doesNotMatch(fate({ status, message: null, outcome, reached_end: true }), /reached|found/);
});

test("what no pass brings is told as a part of its region, and why", () => {
  const lost = { region: 3, area_mm2: 54.6, share: 0.25, why: "the rig cannot face it" };
  assert.equal(outOfReach(lost), "Unreachable: 55 mm² of region 3 (25.0\u202f% of what is wanted there): the rig cannot face it");
  assert.match(outOfReach({ ...lost, region: null }), /outside of any region, as guessed/);
});

test("while a plan is made that is said, with the seconds once there are some", () => {
  assert.equal(planning(0.4), "Planning passes…");
  assert.match(planning(12.7), /^Planning passes… 12 s$/);
});

test("a loop says whether it scans or plans, and why it ended", () => {
  const loop = { running: true, passes: 3, max_passes: 20, why_ended: null };
  assert.equal(loopSaid(loop, [{ status: "done" }, { status: "running" }]), "Closed loop: pass 3 of at most 20");
  assert.equal(loopSaid(loop, [{ status: "done" }]), "Closed loop: planning, 3 of at most 20 passes done");
  assert.equal(loopSaid({ ...loop, running: false, why_ended: "nothing is left" }, []), "The loop ended: nothing is left.");
});

test("the focus stays on what it was on, and never comes to the laser by itself", () => {
  const button = (order, action) => ({ dataset: { order, action } });
  const drawn = [button("2", "carry-out"), button("2", "cancel"), button("1", "carry-out"), button("1", "cancel")];
  assert.equal(sameButton(drawn, { order: "1", action: "cancel" }), drawn[3]);
  assert.equal(sameButton(drawn.slice(0, 3), { order: "1", action: "cancel" }), null);
});
