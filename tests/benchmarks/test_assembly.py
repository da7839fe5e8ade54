import pytest
from targets import has_fused_multiply_add

from benchmarks.assembly import NotCounted, Operations, count, count_text
from benchmarks.roofline import divide, move, multiply_add, pieces, take_root
from estimator.lanes import lanewise, rows

on_x86 = pytest.mark.skipif(not has_fused_multiply_add(), reason="counts x86-64 assembly with AVX and FMA")

UNROLLED_TWICE = """
        vmovupd (%rdi,%rax,8), %zmm0
        vmulpd  256(%rdi,%rax,8), %zmm0, %zmm1
        vfmadd213pd     512(%rdi,%rax,8), %zmm0, %zmm1
        vmovupd %zmm1, 768(%rdi,%rax,8) {%k1}
        vmovups %zmm1, 64(%rsp)
        vmovupd 64(%rdi,%rax,8), %zmm2
        vmulpd  320(%rdi,%rax,8), %zmm2, %zmm3
        vfmadd213pd     576(%rdi,%rax,8), %zmm2, %zmm3
        vdivpd  %zmm3, %zmm2, %zmm4
        vsqrtpd %zmm4, %zmm4
        vmovupd %zmm3, 832(%rdi,%rax,8)
        vpaddq  %zmm3, %zmm3, %zmm4
        addq    $128, %rax
        jne     .LBB0_1
"""


def test_text_is_counted_per_pass() -> None:
    counted = count_text(UNROLLED_TWICE, outputs=1)
    assert counted == Operations(
        simple=1, fused=1, divisions=0.5, roots=0.5, loads=3, stores=1.5, vector_bits=512
    )  # fmt: skip
    assert counted.flops == 4


def test_scalar_code_is_not_taken_for_vectors() -> None:
    with pytest.raises(NotCounted, match="not vectorised"):
        count_text("\tvmulsd\t(%rdi), %xmm0, %xmm0\n\tvmovsd\t%xmm0, 8(%rdi)\n", outputs=1)


def test_what_is_the_same_in_all_lanes_may_be_computed_once_before_the_loop() -> None:
    once = "\tvmulsd\t%xmm1, %xmm1, %xmm1\n"
    loop = f"\tje\t.LBB0_3\n.LBB0_1:\n{UNROLLED_TWICE}.LBB0_3:\n"
    assert count_text(once + loop, outputs=1) == count_text(UNROLLED_TWICE, outputs=1)
    with pytest.raises(NotCounted, match="not vectorised"):
        count_text(loop.replace(".LBB0_1:\n", f".LBB0_1:\n{once}"), outputs=1)
    with pytest.raises(NotCounted, match="not vectorised"):
        count_text(once + UNROLLED_TWICE, outputs=1)


def test_text_without_stores_is_refused() -> None:
    with pytest.raises(NotCounted, match="passes are not clear"):
        count_text("\tvmulpd\t%zmm0, %zmm0, %zmm0\n", outputs=1)


@on_x86
def test_a_function_has_the_operations_that_one_counts_by_hand() -> None:
    @lanewise(rows("a b c d"), "c d", uniform="x")
    def example(a, b, x):
        product = a * b + x
        return product / (a - b), product * product

    counted = count(example)
    assert (counted.simple, counted.fused, counted.divisions, counted.roots) == (2, 1, 1, 0)
    assert counted.flops == 5
    assert (counted.loads, counted.stores) == (2, 2)


@on_x86
@pytest.mark.parametrize("factorisation", ["structured", "mean_field"])
def test_every_piece_of_a_step_is_counted(factorisation: str) -> None:
    for name, functions in pieces(factorisation).items():
        assert sum((count(function) * times for function, times in functions.items()), Operations()).flops > 10, name


@on_x86
def test_the_yardsticks_do_what_they_say() -> None:
    assert (count(multiply_add).fused, count(multiply_add).flops) == (64, 128)
    assert (count(divide).divisions, count(divide).flops) == (4, 4)
    assert (count(take_root).roots, count(take_root).flops) == (4, 4)
    assert (count(move).loads, count(move).stores) == (4, 4)


def test_operations_add_and_multiply() -> None:
    total = Operations(simple=1, fused=2, divisions=3, vector_bits=256) * 3 + Operations(roots=1, vector_bits=512)
    assert total == Operations(simple=3, fused=6, divisions=9, roots=1, vector_bits=512)
    assert total.flops == 3 + 12 + 9 + 1
