import torch

from tests.conftest import small_primitive
from torch_ebip import Localisation, ebip


def made(start: float = 0.1) -> Localisation:
    return Localisation(("a", "b", "c"), torch.tensor([0, 0, 1, 2]), torch.tensor([1, 2, 2]), start)


def test_starts_just_below_one_and_stays_a_correlation_matrix() -> None:
    part = made()
    assert (part.matrix > 0.98).all()
    for seed in range(20):
        with torch.no_grad():
            part.loadings.raw.copy_(6 * torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)))
        matrix = part.matrix
        torch.testing.assert_close(matrix.diagonal(), torch.ones(3))
        assert ((matrix >= 0) & (matrix <= 1 + 1e-6)).all()
        assert torch.linalg.eigvalsh(matrix.double()).min() > -1e-6


def test_blocks_can_be_cut_off_alone_or_together() -> None:
    part = made()
    with torch.no_grad():
        part.loadings.raw[1, 1] = 8.0
    assert part.matrix[0, 1] < 0.02
    assert part.matrix[0, 2] > 0.98
    together = made()
    with torch.no_grad():
        together.loadings.raw[1, 1] = 8.0
        together.loadings.raw[2, 1] = 8.0 + torch.tensor(10.0).log()
    assert together.matrix[1, 2] > 0.99
    assert together.matrix[0, 1] < 0.02


def test_taper_spreads_the_blocks() -> None:
    part = made()
    with torch.no_grad():
        part.loadings.raw[1, 1] = 2.0
    taper, matrix = part(), part.matrix
    assert taper.state.shape == (4, 3)
    assert taper.observation.shape == (3, 3)
    assert taper.state[0, 0] == matrix[0, 1]
    assert taper.state[3, 2] == matrix[2, 2]
    assert taper.observation[0, 1] == matrix[1, 2]


def test_a_modality_that_is_cut_off_moves_nothing_else() -> None:
    primitive = small_primitive()
    filter, cut = ebip(primitive, square_root=True), ebip(primitive, localise=True, square_root=True)
    with torch.no_grad():
        cut.analysis.localisation.loadings.raw[2, 2] = 12.0  # the gaze
    state = filter.initial_state()
    observed = torch.tensor([False, False, True, False, False])
    plain, localised = (made.update(state, torch.full((5,), 3.0), observed)[0].mean for made in (filter, cut))
    gaze = torch.zeros(32, dtype=torch.bool)
    gaze[2 + 12 : 2 + 18] = True
    torch.testing.assert_close(localised[gaze], plain[gaze])
    moved = (plain - state.mean)[~gaze].norm()
    assert moved > 1
    assert (localised - state.mean)[~gaze].norm() < 0.02 * moved
