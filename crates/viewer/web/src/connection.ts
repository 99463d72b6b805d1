// The socket to the program: asks go out, what is told comes in, and a lost connection is tried again.

import type { Ask, Tell } from "./messages";

export type Told<K extends Tell["kind"]> = Extract<Tell, { kind: K }>;
export type ConnectionState = { kind: "connecting" } | { kind: "open" } | { kind: "lost"; retryAt: number };

/** Milliseconds before the first try, and the most between two. */
const FIRST_WAIT = 1000;
const LONGEST_WAIT = 8000;

export class Connection {
  /** What stands behind the page's address: the token, where there is one. */
  readonly query: string;
  private socket: WebSocket | null = null;
  private wait = FIRST_WAIT;
  private timer = 0;
  private readonly listeners = new Map<string, ((tell: never) => void)[]>();
  private readonly binary: ((id: number, blob: Blob) => void)[] = [];
  private readonly states: ((state: ConnectionState) => void)[] = [];

  constructor() {
    const token = new URLSearchParams(location.search).get("token");
    this.query = token ? `?token=${encodeURIComponent(token)}` : "";
  }

  get isOpen(): boolean {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  on<K extends Tell["kind"]>(kind: K, hear: (tell: Told<K>) => void): void {
    this.listeners.set(kind, [...(this.listeners.get(kind) ?? []), hear]);
  }

  /** Pictures: the id that they were asked with, and a JPEG. */
  onPicture(see: (id: number, blob: Blob) => void): void {
    this.binary.push(see);
  }

  onState(hear: (state: ConnectionState) => void): void {
    this.states.push(hear);
  }

  /** Whether the message went out. */
  send(ask: Ask): boolean {
    if (!this.isOpen) return false;
    this.socket?.send(JSON.stringify(ask));
    return true;
  }

  connect(): void {
    clearTimeout(this.timer);
    if (this.socket && this.socket.readyState <= WebSocket.OPEN) return;
    this.tell({ kind: "connecting" });
    const socket = new WebSocket(`ws://${location.host}/socket${this.query}`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.wait = FIRST_WAIT;
      this.tell({ kind: "open" });
    };
    socket.onmessage = (e) => this.hear(e.data as string | ArrayBuffer);
    socket.onclose = () => {
      this.tell({ kind: "lost", retryAt: Date.now() + this.wait });
      this.timer = window.setTimeout(() => this.connect(), this.wait);
      this.wait = Math.min(this.wait * 2, LONGEST_WAIT);
    };
  }

  private tell(state: ConnectionState): void {
    this.states.forEach((f) => f(state));
  }

  private hear(data: string | ArrayBuffer): void {
    if (typeof data === "string") {
      const tell = JSON.parse(data) as Tell;
      this.listeners.get(tell.kind)?.forEach((f) => f(tell as never));
      return;
    }
    const id = new DataView(data).getUint32(0, true);
    const blob = new Blob([new Uint8Array(data, 4)], { type: "image/jpeg" });
    this.binary.forEach((f) => f(id, blob));
  }
}
