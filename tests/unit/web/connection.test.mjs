// Laws of the live socket's life: an in-process stand-in for the browser's WebSocket, and a clock that is turned by hand.

import assert from "node:assert/strict";
import { test } from "node:test";

const { LiveConnection } = await import("../../../scanner_service/web/static/live_connection.js");

function scene({ random = () => 1, scanning = true } = {}) {
  const made = { sockets: [], states: [], texts: [], binary: [], time: 0, timers: [] };
  const open = (url) => {
    const socket = { url, readyState: 0, sent: [], send: (text) => socket.sent.push(JSON.parse(text)), close: () => { socket.readyState = 3; } };
    made.sockets.push(socket);
    return socket;
  };
  const setTimer = (action, ms) => {
    const timer = { action, due: made.time + ms };
    made.timers.push(timer);
    return timer;
  };
  const clearTimer = (timer) => { made.timers = made.timers.filter((other) => other !== timer); };
  made.pass = (ms) => {
    const end = made.time + ms;
    for (;;) {
      const next = made.timers.filter(({ due }) => due <= end).sort((a, b) => a.due - b.due)[0];
      if (!next) break;
      clearTimer(next);
      made.time = next.due;
      next.action();
    }
    made.time = end;
  };
  made.accept = () => {
    const socket = made.sockets.at(-1);
    socket.readyState = 1;
    socket.onopen({});
    return socket;
  };
  made.live = new LiveConnection("ws://part/live", {
    onBinary: (data) => made.binary.push(data), onText: (text) => made.texts.push(text), onState: (state) => made.states.push(state),
    isScanning: () => scanning, open, setTimer, clearTimer, now: () => made.time, random,
  });
  made.live.connect();
  return made;
}

const lose = (socket, code = 1006) => socket.onclose({ code, reason: "" });

test("the first words are the credit window, and grants add to it", () => {
  const made = scene();
  const socket = made.accept();
  made.live.grant(3);
  assert.deepEqual(socket.sent, [{ credit: 8 }, { credit: 3 }]);
});

test("pauses between attempts double up to 15 s and start anew once the service has spoken", () => {
  const made = scene();
  const pauses = [];
  for (let i = 0; i < 8; i += 1) {
    lose(made.sockets.at(-1));
    pauses.push(made.states.at(-1).seconds);
    made.pass(made.states.at(-1).seconds * 1000);
  }
  assert.deepEqual(pauses, [0.5, 1, 2, 4, 8, 15, 15, 15]);
  made.accept().onmessage({ data: "{}" });
  lose(made.sockets.at(-1));
  assert.equal(made.states.at(-1).seconds, 0.5);
});

test("a service that accepts and hangs up without a word does not reset the pauses", () => {
  const made = scene();
  for (const expected of [0.5, 1, 2]) {
    lose(made.accept());
    assert.equal(made.states.at(-1).seconds, expected);
    made.pass(expected * 1000);
  }
});

test("chance shortens a pause by a quarter at most", () => {
  const made = scene({ random: () => 0 });
  lose(made.sockets[0]);
  assert.equal(made.states.at(-1).seconds, 0.375);
});

for (const [code, state] of [[1000, "finished"], [4404, "absent"]]) {
  test(`closing ${code} is final: ${state}`, () => {
    const made = scene();
    lose(made.accept(), code);
    made.pass(60000);
    assert.equal(made.states.at(-1).state, state);
    assert.equal(made.sockets.length, 1);
  });
}

test("silence during a scan is told after 5 s and ends the socket after 20 s", () => {
  const made = scene();
  made.accept();
  made.pass(4900);
  assert.equal(made.states.at(-1).state, "open");
  made.pass(1200);
  assert.equal(made.states.at(-1).state, "quiet");
  made.pass(16000);
  assert.equal(made.sockets.length, 2);
});

test("a stopped session may be silent for ever", () => {
  const made = scene({ scanning: false });
  made.accept();
  made.pass(3600000);
  assert.equal(made.sockets.length, 1);
  assert.equal(made.states.at(-1).state, "open");
});

test("a word ends the quiet", () => {
  const made = scene();
  const socket = made.accept();
  made.pass(6500);
  socket.onmessage({ data: "{}" });
  made.pass(1000);
  assert.equal(made.states.at(-1).state, "open");
});

test("what an abandoned socket still says is not heard", () => {
  const made = scene();
  const old = made.accept();
  made.live.restart("a gap");
  made.pass(500);
  made.accept();
  old.onmessage({ data: new ArrayBuffer(4) });
  lose(old);
  assert.deepEqual(made.binary, []);
  assert.equal(made.states.at(-1).state, "open");
});

test("closing ends everything: no timer, no further attempt", () => {
  const made = scene();
  lose(made.accept());
  made.live.close();
  made.pass(60000);
  assert.equal(made.sockets.length, 1);
  assert.equal(made.timers.length, 0);
});
