// A file dropped on the page or chosen in the dialog: brought to the service, played there, and opened; reads no byte of it.

import { byId } from "./element.js";
import { bringFile, createSession, startSession } from "./service.js";

const holdsFiles = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files");

export class FileBringer {
  #busy = false;

  // onSession(session) opens one; onMesh(name) hears of a nominal part that was brought; onNews(text) says how far it is;
  // onRefusal(text) what was refused.
  constructor({ onSession, onMesh, onNews, onRefusal }) {
    this.onSession = onSession;
    this.onMesh = onMesh;
    this.onNews = onNews;
    this.onRefusal = onRefusal;
    const sign = byId("drop");
    addEventListener("dragover", (event) => {
      if (!holdsFiles(event)) return;
      event.preventDefault(); // or the browser would leave the page for the file
      sign.hidden = false;
    });
    addEventListener("dragleave", (event) => {
      if (!event.relatedTarget) sign.hidden = true; // out of the window
    });
    addEventListener("drop", (event) => {
      sign.hidden = true;
      if (!holdsFiles(event)) return;
      event.preventDefault();
      this.#take(event.dataTransfer.files);
    });
    byId("choose-file").addEventListener("click", () => byId("file").click());
    byId("file").addEventListener("change", (event) => {
      this.#take(event.target.files);
      event.target.value = ""; // the same file may be chosen again
    });
  }

  async #take(files) {
    if (this.#busy) return this.onRefusal("A file is on its way already: bring the next one when it is open.");
    if (files.length !== 1) return this.onRefusal("Bring one file at a time.");
    this.#busy = true;
    const [file] = files;
    try {
      this.onNews(`Bringing ${file.name}…`);
      const kept = await bringFile(file, (share) => this.onNews(`Bringing ${file.name}: ${Math.round(100 * share)} %`));
      if (kept.kind === "mesh") {
        this.onNews("");
        this.onMesh(kept.name);
        return;
      }
      this.onNews(`Reading ${file.name}…`);
      const session = await createSession(file.name, { kind: "replay", file: kept.name });
      await startSession(session.id);
      this.onSession(session);
    } catch (refusal) {
      this.onNews("");
      this.onRefusal(refusal.message);
    } finally {
      this.#busy = false;
    }
  }
}
