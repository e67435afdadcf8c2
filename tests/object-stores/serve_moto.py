"""moto's S3 on a port of loopback, one request at a time: python serve_moto.py PORT

moto looks whether an object exists first and writes it later. Its threads seldom meet in between, but a
test that runs for hours would see two writers win; S3 does not let that happen.
"""

import io
import sys
import threading

from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import run_simple

moto = DomainDispatcherApplication(create_backend_app)
lock = threading.Lock()


def one_at_a_time(environ, start_response):
    # The body is read before the turn: a client that is slow, or gone, holds nobody up.
    length = int(environ.get("CONTENT_LENGTH") or 0)
    environ["wsgi.input"] = io.BytesIO(environ["wsgi.input"].read(length))
    with lock:
        return list(moto(environ, start_response))


run_simple("127.0.0.1", int(sys.argv[1]), one_at_a_time, threaded=True)
