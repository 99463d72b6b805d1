// The socket to the program: sends and receives messages, and reconnects when the connection is lost.

import type { ClientMessage, ServerMessage } from "./messages";

export type Received<K extends ServerMessage["kind"]> = Extract<ServerMessage, { kind: K }>;
export type ConnectionState = { kind: "connecting" } | { kind: "open" } | { kind: "lost"; retryAt: number };

/** Milliseconds before the first retry, and the longest time between two retries. */
const FIRST_WAIT = 1000;
const LONGEST_WAIT = 8000;

export class Connection {
  /** Query part of the page's address: the token, if there is one. */
  readonly query: string;
  private socket: WebSocket | null = null;
  private wait = FIRST_WAIT;
  private timer = 0;
  private readonly listeners = new Map<string, ((message: never) => void)[]>();
  private readonly binary: ((id: number, blob: Blob) => void)[] = [];
  private readonly states: ((state: ConnectionState) => void)[] = [];

  constructor() {
    const token = new URLSearchParams(location.search).get("token");
    this.query = token ? `?token=${encodeURIComponent(token)}` : "";
  }

  get isOpen(): boolean {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  on<K extends ServerMessage["kind"]>(kind: K, hear: (message: Received<K>) => void): void {
    this.listeners.set(kind, [...(this.listeners.get(kind) ?? []), hear]);
  }

  /** Calls `hear` with each picture: the id of its request, and a JPEG. */
  onPicture(hear: (id: number, blob: Blob) => void): void {
    this.binary.push(hear);
  }

  onState(hear: (state: ConnectionState) => void): void {
    this.states.push(hear);
  }

  /** Returns whether the message was sent. */
  send(message: ClientMessage): boolean {
    if (!this.isOpen) return false;
    this.socket?.send(JSON.stringify(message));
    return true;
  }

  connect(): void {
    clearTimeout(this.timer);
    if (this.socket && this.socket.readyState <= WebSocket.OPEN) return;
    this.report({ kind: "connecting" });
    const socket = new WebSocket(`ws://${location.host}/socket${this.query}`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.wait = FIRST_WAIT;
      this.report({ kind: "open" });
    };
    socket.onmessage = (e) => this.receive(e.data as string | ArrayBuffer);
    socket.onclose = () => {
      this.report({ kind: "lost", retryAt: Date.now() + this.wait });
      this.timer = window.setTimeout(() => this.connect(), this.wait);
      this.wait = Math.min(this.wait * 2, LONGEST_WAIT);
    };
  }

  private report(state: ConnectionState): void {
    this.states.forEach((f) => f(state));
  }

  private receive(data: string | ArrayBuffer): void {
    if (typeof data === "string") {
      const message = JSON.parse(data) as ServerMessage;
      this.listeners.get(message.kind)?.forEach((f) => f(message as never));
      return;
    }
    const id = new DataView(data).getUint32(0, true);
    const blob = new Blob([new Uint8Array(data, 4)], { type: "image/jpeg" });
    this.binary.forEach((f) => f(id, blob));
  }
}
