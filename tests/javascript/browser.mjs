// Drives a real browser for tests: node browser.mjs CHROMIUM
//
// Each line of standard input is one command as JSON, each line of standard output its answer: {"value"} or
// {"error"}. Commands: {"open": URL}, {"evaluate": "expression"}, {"wait": "expression"} until it is true,
// {"screenshot": FILE}, {"size": [WIDTH, HEIGHT]},
// {"move": [X, Y]} of the pointer, {"press": KEY}, {"errors": true} for errors of the page. The end of the input closes the browser.

import { createInterface } from "node:readline";
import { chromium } from "playwright-core";

const TIMEOUT_MS = 60_000;
const browser = await chromium.launch({
  executablePath: process.argv[2],
  timeout: TIMEOUT_MS,
  args: [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
  ],
});
const page = await browser.newPage({ viewport: { width: 1024, height: 640 }, bypassCSP: true });
page.setDefaultTimeout(TIMEOUT_MS);
const errors = [];
page.on("pageerror", (error) => errors.push(String(error)));
page.on("console", (message) => {
  if (message.type() === "error" && !message.text().includes("net::ERR_")) errors.push(message.text());
});

async function execute(command) {
  if (command.open) return void (await page.goto(command.open));
  if (command.evaluate) return page.evaluate(command.evaluate);
  if (command.wait) return void (await page.waitForFunction(command.wait, null, { polling: 50 }));
  if (command.screenshot) return void (await page.screenshot({ path: command.screenshot }));
  if (command.move) return void (await page.mouse.move(command.move[0], command.move[1]));
  if (command.press) return void (await page.keyboard.press(command.press));
  if (command.size) return void (await page.setViewportSize({ width: command.size[0], height: command.size[1] }));
  if (command.errors) return errors;
  throw new Error("unknown command");
}

for await (const line of createInterface({ input: process.stdin })) {
  let answer;
  try {
    answer = { value: (await execute(JSON.parse(line))) ?? null };
  } catch (error) {
    answer = { error: String(error) };
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
await browser.close();
