// Asks for a token where one is needed, and keeps it in the browser if that is wanted.

import { $, put, show } from "./dom.js";

const KEY = "canductor.token";

export class Login {
  token = read();

  constructor(on_token) {
    $("login").addEventListener("submit", (event) => {
      event.preventDefault();
      this.token = $("token").value.trim();
      keep(this.token, $("keep").checked);
      $("token").value = "";
      show($("login"), false);
      on_token(this.token);
    });
  }

  ask(fault) {
    if (fault.code === "bad_token") {
      forget();
      this.token = undefined;
    }
    put($("login-told"), fault.code === "bad_token" ? "This token is not known to the machine." : "This page needs a token of the machine.");
    show($("login"), true);
  }

  hide() {
    show($("login"), false);
  }
}

function read() {
  try {
    return sessionStorage.getItem(KEY) ?? localStorage.getItem(KEY) ?? undefined;
  } catch {
    return undefined; // a browser that keeps nothing
  }
}

function keep(token, for_good) {
  try {
    sessionStorage.setItem(KEY, token);
    if (for_good) localStorage.setItem(KEY, token);
  } catch {
    return;
  }
}

function forget() {
  try {
    sessionStorage.removeItem(KEY);
    localStorage.removeItem(KEY);
  } catch {
    return;
  }
}
