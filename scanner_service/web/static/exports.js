// The export menu: files that are ready at once, and formats that the service writes while one waits.

import { element } from "./element.js";
import { exportAddress, fileAddress, getExport, listExports, orderExport } from "./service.js";

const POLL_MS = 700;
const READY = { "points.ply": "points with normals, density and flags", "density.png": "density map as a picture", "regions.json": "rescan regions", "summary.json": "summary of the session" };

export class ExportMenu {
  #place;
  #session = null;

  constructor(place, menu) {
    this.#place = place;
    menu.addEventListener("toggle", () => menu.open && this.#offer());
  }

  // Shows the menu of a session; what is being written for another one goes on, and is found there again.
  open(session) {
    this.#session = session;
    this.#place.replaceChildren(...this.#ready(), element("li.more", {}, "More formats when the menu is opened."));
  }

  #ready() {
    return Object.entries(READY).map(([file, text]) => element("li", {}, element("a", { href: exportAddress(this.#session, file), download: file }, file, element("span", {}, text))));
  }

  async #offer() {
    const session = this.#session;
    try {
      const { formats, exports } = await listExports(session);
      if (session !== this.#session) return;
      this.#place.replaceChildren(...this.#ready(), ...formats.map((format) => this.#format(session, format)));
      for (const job of [...exports].reverse()) if (job.formats.length === 1) this.#show(session, job);
    } catch (refusal) {
      this.#place.querySelector(".more")?.replaceChildren(refusal.message);
    }
  }

  #format(session, { name, what, available, why_not: whyNot }) {
    const button = element("button.export", { type: "button", disabled: !available, title: whyNot, onclick: () => this.#order(session, name) }, name.toUpperCase(), element("span", {}, available ? what : "not installed"));
    return element("li", { "data-format": name }, button, element("div.written", { role: "status" }));
  }

  #row(name) {
    return this.#place.querySelector(`[data-format="${name}"]`);
  }

  async #order(session, name) {
    try {
      await this.#follow(session, await orderExport(session, [name]));
    } catch (refusal) {
      this.#row(name)?.querySelector(".written").replaceChildren(refusal.message);
    }
  }

  async #follow(session, ordered) {
    let job = ordered;
    while (session === this.#session) {
      this.#show(session, job);
      if (job.state === "done" || job.state === "failed") return;
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      job = await getExport(session, job.id);
    }
  }

  #show(session, job) {
    const row = this.#row(job.formats[0]);
    if (!row) return;
    row.querySelector("button").disabled = job.state === "waiting" || job.state === "writing";
    const place = row.querySelector(".written");
    if (job.state === "failed") place.replaceChildren(job.failure);
    else if (job.state === "done") place.replaceChildren(...job.files.map(({ name }) => element("a", { href: fileAddress(session, job.id, name), download: name }, `Save ${name}`)));
    else place.replaceChildren(element("progress", { max: 1, value: job.share }), ` ${job.doing || "waiting"}`);
  }
}
