// The dialog that lists sessions and the choice of the first one; opens no stream.

import { byId } from "./element.js";
import { moment } from "./numbers.js";
import { drawSessions, sessionDetail, UNDER_WAY } from "./panels.js";
import { deleteSession, listSessions } from "./service.js";

const RETRY_MS = 1000;

const newestFirst = (sessions) => [...sessions].sort((a, b) => new Date(b.created ?? 0) - new Date(a.created ?? 0));

// The newest session that scans, else the newest that has scanned anything, else the newest of all, else null.
export function firstChoice(sessions) {
  const sorted = newestFirst(sessions);
  return sorted.find(({ state }) => UNDER_WAY.has(state)) ?? sorted.find(({ lines }) => lines > 0) ?? sorted[0] ?? null;
}

export class SessionPicker {
  #next = null;
  #sessions = [];

  // onChoose(session) opens one; onMissing(text) says why there is none yet.
  constructor({ onChoose, onMissing, current }) {
    this.dialog = byId("sessions");
    this.onChoose = onChoose;
    this.onMissing = onMissing;
    this.current = current;
    byId("open-sessions").addEventListener("click", () => this.show());
    byId("close-sessions").addEventListener("click", () => this.dialog.close());
    byId("more-sessions").addEventListener("click", () => this.#load(this.#next));
    this.dialog.addEventListener("click", (event) => {
      if (event.target === this.dialog) this.dialog.close(); // a click beside it
    });
  }

  show() {
    if (!this.dialog.open) this.dialog.showModal();
    this.#load(null);
  }

  // Choose at once: the session named in the address, else the one that is likely wanted; waits for one to appear.
  async begin(named) {
    try {
      const { sessions } = await listSessions();
      const choice = named ? (sessions.find((session) => session.id === named) ?? { id: named, name: named, state: "" }) : firstChoice(sessions);
      if (choice) {
        this.onChoose(choice);
        return;
      }
      this.onMissing("No session yet. It appears here as soon as one is started.");
    } catch (refusal) {
      this.onMissing(refusal.message);
    }
    setTimeout(() => {
      if (!this.current()) this.begin(named);
    }, RETRY_MS);
  }

  async #load(next) {
    const message = byId("sessions-message");
    try {
      const page = await listSessions(next);
      this.#sessions = next ? [...this.#sessions, ...page.sessions] : page.sessions;
      this.#next = page.next ?? null;
      message.hidden = true;
    } catch (refusal) {
      message.hidden = false;
      message.textContent = refusal.message;
    }
    byId("more-sessions").hidden = !this.#next;
    const choose = (id) => {
      this.dialog.close();
      this.onChoose(this.#sessions.find((session) => session.id === id));
    };
    drawSessions(byId("session-list"), newestFirst(this.#sessions), this.current(), (session) => sessionDetail(session, moment(session.created)), choose, (id) => this.#delete(id));
  }

  // Asks first, and says what would go.
  async #delete(id) {
    const session = this.#sessions.find((candidate) => candidate.id === id);
    if (!confirm(`Delete "${session.name || id}" for good? It holds ${sessionDetail(session, moment(session.created))}.`)) return;
    const message = byId("sessions-message");
    try {
      await deleteSession(id);
      await this.#load(null);
    } catch (refusal) {
      message.hidden = false;
      message.textContent = refusal.message;
    }
  }
}
