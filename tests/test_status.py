"""What is said of a pair, and that several findings make the gravest one the status."""

import pytest

from gavo_jax.status import BY_GRAVITY, AlignmentStatus, as_findings, bit, gravest


def test_statuses_say_a_sentence() -> None:
    sentences = {status.sentence for status in AlignmentStatus}
    assert len(sentences) == len(AlignmentStatus)
    assert all(sentence[0].isupper() and sentence.endswith(".") for sentence in sentences)


def test_every_status_is_a_bit_of_its_own() -> None:
    assert len({bit(status) for status in AlignmentStatus}) == len(AlignmentStatus)
    found = as_findings({AlignmentStatus.AMBIGUOUS: True, AlignmentStatus.LOW_OVERLAP: False})
    assert found == bit(AlignmentStatus.AMBIGUOUS)


@pytest.mark.parametrize(("lighter", "graver"), list(zip(BY_GRAVITY, BY_GRAVITY[1:], strict=False)))
def test_of_two_findings_the_graver_is_the_status(lighter: AlignmentStatus, graver: AlignmentStatus) -> None:
    assert gravest(bit(lighter) | bit(graver)) == graver and gravest(bit(lighter)) == lighter
    assert gravest(0) == AlignmentStatus.OK
