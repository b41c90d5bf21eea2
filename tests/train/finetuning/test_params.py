"""Which of two sections a training follows."""

import pytest
from pydantic import ValidationError

from pipeline.train.finetuning import head_params


def test_finetune_is_laid_over_train_head(params):
    given = params(train_head={"batch_size": 99, "seed": 3, "drop_features": 0.2})
    head = head_params(given)
    assert (head.batch_size, head.max_steps, head.eval_every) == (6, 5, 3)
    assert (head.output, head.logs) == (given.finetune.output, given.finetune.logs)
    assert (head.seed, head.drop_features, head.lr) == (3, 0.2, given.train_head.lr)


@pytest.mark.parametrize(("section", "place"), [("finetune", "output"), ("train_head", "logs")])
def test_what_is_renamed_is_a_folder_of_its_own(params, section, place):
    with pytest.raises(ValidationError, match=rf"{section}\.{place}\n.*a folder of its own"):
        params(**{section: {place: "."}})
