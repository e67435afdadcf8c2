// Creates a container on Azurite: node create_container.mjs PORT NAME
//
// The account and its key are those that Azurite documents for everyone; they protect nothing.
import { createHmac } from "node:crypto";

const [port, name] = process.argv.slice(2);
const account = "devstoreaccount1";
const key =
  "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw==";

const date = new Date().toUTCString();
const version = "2021-12-02";
// "Authorize with Shared Key" of the Azure Storage REST API: verb, eleven empty headers, our
// headers, the resource (the account twice, as emulators want it), the query.
const text = [
  "PUT", ...Array(11).fill(""),
  `x-ms-date:${date}`, `x-ms-version:${version}`,
  `/${account}/${account}/${name}`, "restype:container",
].join("\n");
const signature = createHmac("sha256", Buffer.from(key, "base64")).update(text).digest("base64");

const answer = await fetch(`http://127.0.0.1:${port}/${account}/${name}?restype=container`, {
  method: "PUT",
  headers: {
    "x-ms-date": date,
    "x-ms-version": version,
    Authorization: `SharedKey ${account}:${signature}`,
  },
});
if (answer.status !== 201) {
  console.error(answer.status, await answer.text());
  process.exit(1);
}
