"""Run the frozen VLM once per VL row and write the store.

Reads the recordings of data.sources, computes pooled features with vlm.checkpoint and writes them,
with the sensor, state and action streams, to extract.store. An interrupted run continues where it
was; a finished store is left alone when nothing changed; added recordings compute only their rows.

  python -m stages.extract                              what params.yaml says
  python -m stages.extract --set extract.plan=true      only say what would be done, and why
  python -m stages.extract --set extract.batch_size=4   smaller batches, the same store
"""

from pipeline.config import Params
from pipeline.extraction import extract
from stages.command import run


def main(params: Params) -> None:
    """Extract and report."""
    store = params.extract.store
    report = extract(params, say=print)
    if report is not None:
        rate = report.computed / report.seconds if report.seconds else 0.0
        print(
            f"{store}: {report.rows} rows, {report.computed} computed ({rate:.1f} rows/s), "
            f"{report.taken} taken over, {report.repeated} equal to another"
        )
        if report.model_share is not None and report.waited_share is not None:
            print(
                f"the model worked {report.model_share:.0%} of the time and waited "
                f"{report.waited_share:.0%} for frames"
            )


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=("data", "vlm", "extract")))
