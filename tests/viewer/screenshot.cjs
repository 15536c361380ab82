// node screenshot.cjs CHROMIUM URL IMAGE SECONDS WIDTH HEIGHT: draws a page without a screen or a GPU, waits, and saves
// what it shows; a JSON line on standard output says which requests left this machine.
const { chromium } = require("playwright-core");

const [executablePath, url, image, seconds, width, height] = process.argv.slice(2);
const args = [
  "--no-sandbox",
  "--use-gl=angle",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--ignore-gpu-blocklist",
  "--disable-background-networking",
  "--disable-component-update",
  "--disable-sync",
  "--no-first-run",
];

(async () => {
  const browser = await chromium.launch({ executablePath, args });
  const page = await browser.newPage({ viewport: { width: Number(width), height: Number(height) } });
  const outside = [];
  const faults = [];
  page.on("request", (request) => {
    const { protocol, hostname } = new URL(request.url());
    if (/^(https?|wss?):$/.test(protocol) && !["127.0.0.1", "localhost"].includes(hostname)) outside.push(request.url());
  });
  page.on("pageerror", (error) => faults.push(String(error)));
  await page.goto(url);
  await page.waitForTimeout(Number(seconds) * 1000);
  await page.screenshot({ path: image });
  console.log(JSON.stringify({ title: await page.title(), outside, faults }));
  await browser.close();
})().catch((error) => {
  console.error(String(error));
  process.exit(1);
});
