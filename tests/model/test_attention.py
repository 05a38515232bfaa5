import pytest
import torch
from torch import Tensor

from vjepa2_ac.model import attention
from vjepa2_ac.model.attention import AttentionKind, best_kind, block_causal_attention

PER_STEP = 5


def drawn(dtype: torch.dtype = torch.float32, steps: int = 4, device: str = "cpu") -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (2, 2, steps * PER_STEP, 16)
    return [torch.randn(shape, generator=generator).to(device, dtype).requires_grad_() for _ in range(3)]


def output_and_gradients(kind: AttentionKind, inputs: list[Tensor]) -> list[Tensor]:
    output = block_causal_attention(*inputs, PER_STEP, kind)
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(1)).to(output)
    return [output, *torch.autograd.grad((output * weights).sum(), inputs)]


@pytest.mark.parametrize("steps", [1, 4])
@pytest.mark.parametrize("kind", ["per_step", "auto"])
def test_every_way_gives_the_output_and_gradients_of_the_dense_mask(kind: AttentionKind, steps: int) -> None:
    inputs = drawn(steps=steps)
    for found, expected in zip(output_and_gradients(kind, inputs), output_and_gradients("dense", inputs), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_ways_agree_in_bfloat16_to_its_rounding() -> None:
    inputs = drawn(torch.bfloat16)
    for found, expected in zip(
        output_and_gradients("per_step", inputs), output_and_gradients("dense", inputs), strict=True
    ):
        assert found.dtype == torch.bfloat16
        torch.testing.assert_close(found, expected, rtol=2e-2, atol=4e-2)


@pytest.mark.parametrize("kind", ["per_step", "dense"])
def test_the_last_steps_alone_see_what_they_see_among_all(kind: AttentionKind) -> None:
    query, key, value = (x.detach() for x in drawn())
    whole = block_causal_attention(query, key, value, PER_STEP, "dense")
    last = block_causal_attention(query[:, :, 2 * PER_STEP :], key, value, PER_STEP, kind)
    torch.testing.assert_close(last, whole[:, :, 2 * PER_STEP :], rtol=1e-5, atol=1e-6)


@pytest.mark.filterwarnings("ignore:flex_attention called without torch.compile")  # eager on purpose: no compiler here
def test_flex_gives_the_output_of_the_dense_mask() -> None:
    inputs = [value.detach() for value in drawn()]
    found = block_causal_attention(*inputs, PER_STEP, "flex")
    whole = block_causal_attention(*inputs, PER_STEP, "dense")
    torch.testing.assert_close(found, whole, rtol=1e-5, atol=1e-6)
    query, key, value = inputs
    last = block_causal_attention(query[:, :, 2 * PER_STEP :], key, value, PER_STEP, "flex")
    torch.testing.assert_close(last, whole[:, :, 2 * PER_STEP :], rtol=1e-5, atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="FlexAttention has gradients on CUDA only")
@pytest.mark.parametrize("kind", ["flex", "per_step", "auto"])
def test_every_way_agrees_on_cuda(kind: AttentionKind) -> None:
    inputs = drawn(device="cuda")
    for found, expected in zip(output_and_gradients(kind, inputs), output_and_gradients("dense", inputs), strict=True):
        torch.testing.assert_close(found, expected, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("kind", ["dense", "per_step"])
def test_a_step_sees_itself_and_the_past_but_not_the_future(kind: AttentionKind) -> None:
    query, key, value = (x.detach() for x in drawn())
    before = block_causal_attention(query, key, value, PER_STEP, kind)
    changed = value.clone()
    changed[:, :, 2 * PER_STEP + 4] += 1.0  # the last token of step 2
    after = block_causal_attention(query, key, changed, PER_STEP, kind)
    same = (before == after).all(dim=-1).all(dim=1).all(dim=0)
    assert same[: 2 * PER_STEP].all()
    assert not same[2 * PER_STEP :].any()


def test_auto_compiles_only_for_long_sequences_with_gradients_on_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu, cuda = torch.device("cpu"), torch.device("cuda")
    monkeypatch.setattr(attention, "has_triton", lambda: True)
    assert best_kind(cuda, 64, 4, gradients=True) == "flex"
    assert best_kind(cuda, 64, 3, gradients=True) == "per_step"
    assert best_kind(cuda, 64, 15, gradients=False) == "per_step"
    assert best_kind(cuda, 12, 15, gradients=True) == "per_step"
    assert best_kind(cpu, 64, 15, gradients=True) == "per_step"
    monkeypatch.setattr(attention, "has_triton", lambda: False)
    assert best_kind(cuda, 64, 15, gradients=True) == "per_step"


@pytest.mark.parametrize("gradients", [True, False])
def test_auto_is_asked_with_the_steps_and_gradients_at_hand(monkeypatch: pytest.MonkeyPatch, gradients: bool) -> None:
    asked = []

    def best(device: torch.device, head_dim: int, steps: int, *, gradients: bool) -> AttentionKind:
        asked.append((device.type, head_dim, steps, gradients))
        return "dense"

    monkeypatch.setattr(attention, "best_kind", best)
    with torch.set_grad_enabled(gradients):
        block_causal_attention(*drawn(steps=3), PER_STEP)
    assert asked == [("cpu", 16, 3, gradients)]


def test_a_sequence_of_broken_steps_is_refused() -> None:
    query = torch.zeros(1, 1, 11, 16)
    with pytest.raises(ValueError, match="not a whole number of steps"):
        block_causal_attention(query, query, query, PER_STEP)


def test_queries_without_a_key_of_their_own_are_refused() -> None:
    query, key = torch.zeros(1, 1, 10, 16), torch.zeros(1, 1, 5, 16)
    with pytest.raises(ValueError, match="10 queries would look at 5 keys"):
        block_causal_attention(query, key, key, PER_STEP)


def test_adding_up_gradients_changes_none_that_came_in() -> None:
    gradients = [torch.randn(1, 1, end, 2, generator=torch.Generator().manual_seed(end)) for end in (2, 4)]
    before = [gradient.clone() for gradient in gradients]
    total, _ = attention._Beginnings.backward(None, *gradients)
    assert all(map(torch.equal, gradients, before))
    assert torch.equal(total[:, :, :2], before[1][:, :, :2] + before[0])
    assert torch.equal(total[:, :, 2:], before[1][:, :, 2:])
