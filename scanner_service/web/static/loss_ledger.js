// The service's tally of losses as balances that can be read: what came in, what was kept, what was not and why; pure.

import { plural, sentence } from "./numbers.js";

const NAMES = {
  pending: "on the way to the record",
  counted: "in the map",
  dropout: "no return",
  out_of_bounds: "beyond the map's bounds",
  device_dropped: "dropped by the device",
  bad_crc: "wrong checksum",
  bad_cobs: "broken framing",
  bytes_skipped: "bytes skipped",
  late_reads: "times this computer read late",
  points_declared: "points in the file",
  under_way: "under way",
  record_busy: "the disk failed",
  service_ended: "under way when the service ended",
  too_late: "after the end",
  outside_pass: "before and after the pass",
  between_stops: "between two stops",
  before_start: "before the stage set off",
  no_position: "no stage position around it",
};

// Lines that were measured and not wanted: a rig's scanner runs on while its stage turns or goes to the next stop.
const UNWANTED = new Set(["outside_pass", "between_stops", "before_start"]);

const PLACES = { missing: "in a piece that never arrived" };

const sum = (tally) => Object.values(tally ?? {}).reduce((total, count) => total + count, 0);

// Rows are [name, count, kind]: kept, aside (no loss: a laser that finds no surface, a line that came twice) or lost.
const row = (key, count, kind, prefix = "") => [sentence(`${prefix}${NAMES[key] ?? key}`), count ?? 0, kind];
const notStored = (lost) => Object.entries(lost ?? {}).map(([key, count]) => (UNWANTED.has(key) ? row(key, count, "aside", "not wanted: ") : row(key, count, "lost", "lost: ")));
const rows = (tally, kind, prefix = "") => Object.entries(tally ?? {}).map(([key, count]) => row(key, count, kind, prefix));

// [{title, unit, total, rows}], the total being null where nothing adds up to one.
export function accounts(losses) {
  const { lines, points, device, passes, ...others } = losses ?? {};
  const made = [];
  if (points) {
    const kinds = Object.entries(points.dropped ?? {}).map(([key, count]) => row(PLACES[key] ?? key, count, key === "dropout" ? "aside" : "lost"));
    made.push({ title: "Points", unit: "places in the scanlines", total: points.places, rows: [row("counted", points.counted, "kept"), ...kinds, ...rows(points.left_out, "aside", "left out: ")] });
  }
  if (lines) {
    const fate = [row("stored", lines.stored, "kept"), row("pending", lines.pending, "aside"), row("duplicates", lines.duplicates, "aside"), row("conflicts", lines.conflicts, "lost")];
    made.push({ title: "Scanlines", unit: "received", total: lines.received, rows: [...fate, ...rows(lines.refused, "lost", "refused: ")] });
  }
  made.push(...passAccounts(passes ?? []));
  if (device) made.push(...(device.lines ? wireAccounts(device) : fileAccounts(device)));
  for (const [key, tally] of Object.entries(others)) made.push({ title: sentence(key), unit: "", total: null, rows: rows(flat(tally, key), "aside") });
  return made;
}

const LATEST_PASSES = 12;

// One balance a pass, from the wire to the record: sent = stored (whole, partial) + under way + lost; the latest ones.
function passAccounts(passes) {
  return passes.slice(-LATEST_PASSES).map(({ device_id: device, pass_index: pass, boot_id: boot, lines }) => {
    const boots = new Set(passes.filter((other) => other.device_id === device).map((other) => other.boot_id));
    const name = `Pass ${pass} of ${device}${boots.size > 1 ? `, boot ${boot}` : ""}`;
    const kept = [row("whole", lines.whole, "kept"), row("partial", lines.partial, "lost")];
    return { title: name, unit: "scanlines sent", total: lines.sent, rows: [...kept, row("under_way", lines.under_way, "aside"), ...notStored(lines.lost)] };
  });
}

function wireAccounts({ lines, chunks, damage, bytes_skipped: bytesSkipped, duplicates, stale, disagreements, late_reads: lateReads }) {
  const made = [
    {
      title: "Scanlines on the wire",
      unit: "sent",
      total: lines.sent,
      rows: [row("whole", lines.whole, "kept"), row("partial", lines.partial, "lost"), row("open", lines.open, "aside"), ...rows(lines.lost, "lost", "lost: ")],
    },
  ];
  if (chunks) made.push({ title: "Chunks on the wire", unit: "sent", total: chunks.sent, rows: [row("stored", chunks.stored, "kept"), ...rows(chunks.lost, "lost", "lost: ")] });
  const noise = [...rows(damage, "lost", "damage: "), row("bytes_skipped", bytesSkipped, "aside"), row("duplicates", duplicates, "aside"), row("stale", stale, "aside"), row("disagreements", disagreements, "lost"), row("late_reads", lateReads, "aside")];
  made.push({ title: "Noise on the wire", unit: "", total: null, rows: noise });
  return made;
}

function fileAccounts({ points_declared: declared, dropped, ...others }) {
  if (declared === undefined) return [{ title: "Device", unit: "", total: null, rows: rows(flat({ dropped, ...others }), "aside") }];
  const kept = ["Read", declared - sum(dropped), "kept"];
  return [{ title: "File", unit: "points", total: declared, rows: [kept, ...rows(dropped, "lost"), ...rows(flat(others), "aside")] }];
}

// A tally nested as deep as it likes, as one of names and counts.
function flat(tally, name = "", into = {}) {
  if (typeof tally === "number") into[name] = tally;
  else for (const [key, part] of Object.entries(tally ?? {})) flat(part, name ? `${name}, ${key}` : key, into);
  return into;
}

// The one line that says it all: what was lost for good. A place without a return is no loss of the service's.
export function headline(losses) {
  if (!losses) return "";
  const { lines, points, device } = losses;
  const passes = losses.passes ?? [];
  const partial = sum(passes.map((account) => account.lines.partial));
  const lostOf = ({ lines: account }) => sum(Object.fromEntries(Object.entries(account.lost ?? {}).filter(([reason]) => !UNWANTED.has(reason))));
  // the accounts of the passes hold all of them, from the wire to the record; the device's end at the wire
  const lostLines = passes.length ? sum(passes.map(lostOf)) : sum(lines?.refused) + (lines?.conflicts ?? 0) + sum(device?.lines?.lost);
  const { dropout: _, ...lostInMap } = points?.dropped ?? {};
  const lostPoints = sum(lostInMap) + (device?.lines ? 0 : sum(device?.dropped));
  const said = [lostLines && plural(lostLines, "scanline", "scanlines"), lostPoints && plural(lostPoints, "point", "points")].filter(Boolean);
  const lost = said.length ? `${said.join(", ")} lost` : "";
  return [lost, partial && `${plural(partial, "scanline", "scanlines")} partial`].filter(Boolean).join(", ") || "nothing lost";
}
