"""A small tuning run for tests/learning/test_ranks.py: `torchrun ... tests/ranks_program.py FOLDER [STEP]`.

At STEP the last of the processes is killed. Rank 0 leaves the validation losses and parameters in FOLDER.
"""

import json
import os
import signal
import sys
from pathlib import Path

from tests.learning.test_tuning import filter_and_tuner
from tests.listening import addresses
from torch_ebip import TuningSettings
from torch_ebip.learning.ranks import RankLostError, Ranks

SETTINGS = TuningSettings(steps=4, batch_size=6, validate_every=2, folds=4, thinning=4, seed=3)


def main(folder: Path, killed_at: int | None) -> None:
    """Tune, and write what came out."""
    ranks = Ranks.start()

    def progress(step: int, loss: float, validation: float) -> None:
        """Die when it is time."""
        if step == killed_at and ranks.rank == ranks.size - 1:
            os.kill(os.getpid(), signal.SIGKILL)

    made, tuner = filter_and_tuner(SETTINGS, factor=300.0, checkpoint=folder / "c.pt", ranks=ranks, progress=progress)
    ranks.explain_on_termination("run it again to go on")
    try:
        result = tuner.run()
    except RankLostError:
        raise SystemExit("run it again to go on") from None
    words = ranks.from_first(lambda: "from the first")
    gathered = ranks.gather(ranks.rank)
    listening = ranks.gather(sorted(addresses()))
    if ranks.first:
        parameters = {name: p.detach().flatten().tolist() for name, p in made.named_parameters()}
        outcome = {"validation": result.validation, "parameters": parameters, "words": words, "ranks": gathered}
        outcome["listening"] = listening
        (folder / "outcome.json").write_text(json.dumps(outcome))
    ranks.stop()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else None)
