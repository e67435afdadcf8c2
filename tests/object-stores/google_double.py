"""A stand-in for Google Cloud Storage: the part of its XML API that Sightline's client uses.

    python google_double.py PORT

Objects of any bucket, in memory: PUT (with x-goog-if-generation-match: 0), GET (with Range and
If-Match), HEAD, DELETE, the listing of version 2 with pages of a thousand, and multipart uploads. One
request is answered at a time where it matters, so that creating if absent is atomic, as Google's is.

It checks that conditional requests are conditional: a test can ask /-/conditional how many PUTs came
with the condition. It is no emulator; where it and Google differ, Google is right.
"""

import hashlib
import re
import sys
import threading
import urllib.parse
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from xml.sax.saxutils import escape

PAGE = 1000
objects = {}
uploads = {}
conditional = 0
generations = 0
lock = threading.Lock()


def etag(data):
    return '"' + hashlib.md5(data).hexdigest() + '"'


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def answer(self, status, body=b"", headers=(), code=None):
        if code:
            body = f"<Error><Code>{code}</Code><Message>{code}</Message></Error>".encode()
        self.send_response(status)
        for name, value in headers:
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def place(self):
        url = urllib.parse.urlsplit(self.path)
        query = dict(urllib.parse.parse_qsl(url.query, keep_blank_values=True))
        return urllib.parse.unquote(url.path.lstrip("/")), query

    def body(self):
        if self.headers.get("Transfer-Encoding", "").lower() == "chunked":
            data = b""
            while size := int(self.rfile.readline().split(b";")[0], 16):
                data += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return data
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def store(self, key, data):
        global generations
        generations += 1
        objects[key] = (data, generations, formatdate(usegmt=True))
        return [("ETag", etag(data)), ("x-goog-generation", str(generations))]

    def do_PUT(self):
        global conditional
        data = self.body()
        key, query = self.place()
        with lock:
            if "uploadId" in query:
                uploads[query["uploadId"]][int(query["partNumber"])] = data
                return self.answer(200, headers=[("ETag", etag(data))])
            wanted = self.headers.get("x-goog-if-generation-match")
            if wanted is not None:
                conditional += 1
                found = objects[key][1] if key in objects else 0
                if str(found) != wanted:
                    return self.answer(412, code="PreconditionFailed")
            self.answer(200, headers=self.store(key, data))

    def do_POST(self):
        data = self.body()
        key, query = self.place()
        with lock:
            if "uploads" in query:
                number = str(len(uploads) + 1)
                uploads[number] = {}
                bucket, _, name = key.partition("/")
                body = (
                    "<InitiateMultipartUploadResult>"
                    f"<Bucket>{escape(bucket)}</Bucket><Key>{escape(name)}</Key>"
                    f"<UploadId>{number}</UploadId></InitiateMultipartUploadResult>"
                )
                return self.answer(200, body.encode())
            parts = uploads.pop(query["uploadId"])
            named = [int(n) for n in re.findall(rb"<PartNumber>(\d+)</PartNumber>", data)]
            whole = b"".join(parts[n] for n in named)
            self.store(key, whole)
            body = (
                "<CompleteMultipartUploadResult><Location>x</Location><Bucket>x</Bucket>"
                f"<Key>x</Key><ETag>{escape(etag(whole))}</ETag></CompleteMultipartUploadResult>"
            )
            self.answer(200, body.encode())

    def do_GET(self):
        key, query = self.place()
        if key == "-/conditional":
            return self.answer(200, str(conditional).encode())
        if query.get("list-type") == "2":
            return self.list(key.strip("/"), query)
        with lock:
            found = objects.get(key)
        if found is None:
            return self.answer(404, code="NoSuchKey")
        data, generation, date = found
        if self.headers.get("If-Match", etag(data)) != etag(data):
            return self.answer(412, code="PreconditionFailed")
        headers = [("ETag", etag(data)), ("Last-Modified", date)]
        headers.append(("x-goog-generation", str(generation)))
        ranged = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if not ranged:
            return self.answer(200, data, headers)
        start, end = int(ranged[1]), int(ranged[2] or len(data) - 1)
        if start >= len(data):
            return self.answer(416, code="InvalidRange")
        part = data[start : end + 1]
        headers.append(("Content-Range", f"bytes {start}-{start + len(part) - 1}/{len(data)}"))
        self.answer(206, part, headers)

    do_HEAD = do_GET

    def do_DELETE(self):
        self.body()
        key, query = self.place()
        with lock:
            if "uploadId" in query:
                uploads.pop(query["uploadId"], None)
                return self.answer(204)
            if objects.pop(key, None) is None:
                return self.answer(404, code="NoSuchKey")
        self.answer(204)

    def list(self, bucket, query):
        prefix, after = query.get("prefix", ""), query.get("continuation-token", "")
        with lock:
            names = sorted(k[len(bucket) + 1 :] for k in objects if k.startswith(bucket + "/"))
            names = [n for n in names if n.startswith(prefix) and n > after]
            page = [(n, *objects[f"{bucket}/{n}"]) for n in names[:PAGE]]
        out = ["<ListBucketResult>"]
        for name, data, _, _ in page:
            out.append(
                f"<Contents><Key>{escape(name)}</Key><Size>{len(data)}</Size>"
                "<LastModified>2026-01-01T00:00:00.000Z</LastModified>"
                f"<ETag>{escape(etag(data))}</ETag></Contents>"
            )
        if len(names) > PAGE:
            token = escape(page[-1][0])
            out.append(f"<NextContinuationToken>{token}</NextContinuationToken>")
        out.append("</ListBucketResult>")
        self.answer(200, "".join(out).encode())


ThreadingHTTPServer(("127.0.0.1", int(sys.argv[1])), Handler).serve_forever()
