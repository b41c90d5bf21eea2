"""Serve a trained policy to robots over a websocket, with the protocol of openpi's clients.

Reads what stages.train_head wrote to train_head.output, or serve.checkpoint if it is set, and the
model of vlm.checkpoint. Before the first connection it proves that this model gives the features
that the policy was trained on. It can be reached from this machine only, unless serve.host says
otherwise; then it needs a token (serve.token_file or VLA_SERVE_TOKEN). /status.json at the same
address has counts, latencies and connections; /healthz says OK. After Ctrl-C it answers the
observations it has received, and stops.

  python -m stages.serve                                    at ws://127.0.0.1:8000
  python -m stages.serve --set serve.port=0                 at a free port, which is printed
  python -m stages.serve --set serve.host=0.0.0.0 --set serve.token_file=token.txt

Next: pipeline.robot.client on the robot's computer, or openpi-client
"""

from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING

from stages.command import run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("serve",)
SHORTHANDS = short("serve", "--checkpoint", "--device")


def main(params: "Params") -> None:
    """Serve the checkpoint that `serve` names, else what `train_head` wrote."""
    from pipeline.robot.server import PolicyServer, listen, read_token
    from pipeline.robot.session import ServedPolicy

    wanted, say = params.serve, partial(print, flush=True)
    token = read_token(wanted)
    folder = wanted.checkpoint or params.train_head.output
    with closing(listen(wanted)) as bound:
        served = ServedPolicy.load(folder, params.vlm, wanted.device, say)
        with closing(served):
            server = PolicyServer(served, wanted, token, bound, say)
            about = served.metadata
            say(
                f"{folder} (step {about['step']}): {about['model_type']}, chunks of "
                f"{about['horizon']} actions at {about['action_hz']:g} Hz"
            )
            access = "robots send the token" if token else "no token is asked for"
            status = f"http://{server.address}/status.json"
            started = f"serving ws://{server.address} ({access}); status: {status}"
            stopped = server.run(partial(say, started))
    if stopped:
        raise KeyboardInterrupt


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
