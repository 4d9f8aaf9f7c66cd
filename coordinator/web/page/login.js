// Signs this browser in, with the code of a one-time link or with a token of the machine. The server then gives two
// secrets: a cookie, which scripts cannot read, and a key, which is kept here. Both are needed. A browser sends the
// cookie to every port of a computer, other users' ports too; the key is kept for this origin alone.

import { $, put, show } from "./dom.js";

const KEY = "canductor.key";

export class Login {
  #key = read();
  #on_key;

  /** ON_KEY gets the key of a session, which may have ended meanwhile. */
  constructor(on_key) {
    this.#on_key = on_key;
    $("login").addEventListener("submit", (event) => {
      event.preventDefault();
      const given = $("token").value.trim().split("#").pop(); // a whole link may be given, too
      $("token").value = "";
      this.#sign_in(given, $("keep").checked);
    });
  }

  /** Use the link's code if the address has one, else the key of an earlier visit. */
  begin() {
    const code = location.hash.slice(1);
    if (code) this.#sign_in(code, true);
    else if (this.#key) this.#on_key(this.#key);
    else this.ask();
  }

  /** The key was refused: use the one of another tab that signed in meanwhile, or ask. */
  refused() {
    const key = read();
    if (key && key !== this.#key) {
      this.#key = key;
      this.#on_key(key);
    } else this.ask();
  }

  /** Show the form; FAULT says why, if something was wrong. */
  ask(fault) {
    put($("login-message"), fault?.message ?? "Open the link that canductor prints, or give it here.");
    show($("login"), true);
  }

  hide() {
    show($("login"), false);
  }

  async #sign_in(token, keep) {
    show($("login"), false);
    let answer;
    let reply;
    try {
      answer = await fetch("/login", { method: "POST", body: JSON.stringify({ token, keep }) });
      reply = await answer.json();
    } catch {
      this.ask({ message: "The machine cannot be reached. Try again." });
      return;
    }
    history.replaceState(null, "", location.pathname); // the code is of no use any more
    if (answer.ok) {
      this.#key = reply.key;
      write(reply.key);
    } else if (!this.#key) {
      this.ask(reply);
      return;
    }
    this.#on_key(this.#key); // a link that was used before does no harm to who is in
  }
}

function read() {
  try {
    return localStorage.getItem(KEY) ?? undefined;
  } catch {
    return undefined; // a browser that keeps nothing
  }
}

function write(key) {
  try {
    localStorage.setItem(KEY, key);
  } catch {
    return; // it holds until the page is left
  }
}
