// The nominal part beside the form of what is asked for: brought as a mesh, and measured against; reads no byte of it.

import { byId } from "./element.js";
import { bringFile, measureAgainst, whileJudged } from "./service.js";

export class NominalPart {
  #id = null;

  // onAsked() hears that a verdict is asked for, onJudging(status) how far it is, onJudged() that it is there, and
  // onRefused() that there will be none.
  constructor({ onAsked, onJudging, onJudged, onRefused }) {
    Object.assign(this, { onAsked, onJudging, onJudged, onRefused });
    byId("nominal-bring").addEventListener("click", () => byId("nominal-file").click());
    byId("nominal-file").addEventListener("change", (event) => {
      const [file] = event.target.files;
      event.target.value = ""; // the same file may be chosen again
      if (file) this.#act(async () => (await bringFile(file, (share) => this.#say(`Bringing ${file.name}: ${Math.round(100 * share)} %`))).name);
    });
    byId("nominal-none").addEventListener("click", () => this.#act(async () => null));
  }

  open(id) {
    this.#id = id;
    this.#refuse("");
    this.#say("");
  }

  status({ settings }) {
    if (byId("nominal-bring").disabled) return; // it says how far it is
    const part = settings?.reference ?? null;
    this.#say(part ? `${part.file}, in ${part.units}` : "none: coverage is of the surface seen");
    byId("nominal-none").hidden = part === null;
  }

  // A mesh that lies in the service's folder already, such as one that was dropped on the page.
  use(name) {
    byId("requirement-fold").open = true;
    return this.#act(async () => name);
  }

  async #act(bring) {
    const id = this.#id;
    this.#refuse("");
    byId("nominal-bring").disabled = true;
    try {
      const name = await bring();
      this.#say(name === null ? "judging without it…" : `judging by ${name}…`);
      this.onAsked();
      await whileJudged(id, measureAgainst(id, name, byId("nominal-units").value), (told) => id === this.#id && this.onJudging(told));
      if (id === this.#id) this.onJudged();
    } catch (refusal) {
      if (id === this.#id) this.onRefused();
      this.#refuse(refusal.message);
    } finally {
      byId("nominal-bring").disabled = false;
    }
  }

  #say(text) {
    byId("nominal-said").textContent = text;
  }

  #refuse(text) {
    byId("why-nominal").textContent = text;
    byId("why-nominal").hidden = !text;
  }
}
