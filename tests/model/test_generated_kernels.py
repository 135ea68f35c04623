"""Generated kernels compute what SymPy does, in both back ends, on both sides of every kink."""

import ctypes
import importlib.util
import pickle
import shutil
import sys

import numpy as np
import pytest
import sympy as sp
from hypothesis import HealthCheck, assume, given, settings, strategies as st
from llvmlite import binding as llvm

from bayesoleo._compiled import BLOCK, BlockKernel
from bayesoleo._machine_code import _target_machine, address_of, cache_folder, unsealed
from bayesoleo.errors import ModelError
from bayesoleo.model import Condition, Model, Output, Parameter
from bayesoleo.model._derivatives import derive
from bayesoleo.model._expressions import FUNCTIONS, symbol
from bayesoleo.model._kernels import (
    MANY_ROWS,
    _counts,
    _results,
    kernels,
    machine_code,
    statements,
)
from bayesoleo.systems import system
from bayesoleo.systems._oleo import thermomechanical_oleo

NAMES = ("x", "w", "a", "b")


def model_of(*expressions: str) -> Model:
    return Model(
        "expressions",
        inputs={"x": "", "w": ""},
        parameters={"a": Parameter(0.7, sd=1.0), "b": Parameter(-1.3, sd=1.0)},
        outputs={f"y{k}": Output(text) for k, text in enumerate(expressions)},
    )


def evaluated(model: Model, backend: str, x: np.ndarray, w: np.ndarray, p: np.ndarray):
    """Outputs (L, ny, N) and their derivatives with respect to ``a`` and ``b`` (L, ny, 2, N)."""
    made = kernels(model, backend=backend)
    table = {("x", 0): x, ("w", 0): w}
    u = np.array([table[row] for row in made.derived.inputs]).reshape(-1, x.size)
    lanes, ny = np.arange(p.shape[0]), len(model.outputs)
    z = np.empty((p.shape[0], 0, x.size))
    y = np.full((p.shape[0], ny, x.size), np.nan)
    yz, yp = np.empty((p.shape[0], ny, 0, x.size)), np.full((p.shape[0], ny, 2, x.size), np.nan)
    with np.errstate(all="ignore"):
        made.output(z, u, p, lanes, y)
        made.output_jacobian(z, u, p, lanes, yz, yp)
    return y, yp


#: One call of every function, with an argument in its domain that takes both signs where it may.
CALLS = {
    "abs": "abs(a*x)",
    "sign": "sign(a*x)",
    "sqrt": "sqrt(1 + (a*x)**2)",
    "exp": "exp(a*x)",
    "log": "log(4 + a*x**2)",
    "sin": "sin(a*x)",
    "cos": "cos(a*x)",
    "tan": "tan(a*x/9)",
    "atan": "atan(a*x)",
    "arctan": "arctan(30*a*x)",
    "tanh": "tanh(a*x)",
    "min": "min(a*x, b, x)",
    "max": "max(a*x, b, x)",
    "positive": "positive(a*x)",
    "step": "step(a*x)",
    "bspline": "bspline(a*x)",
    "bspline_slope": "bspline_slope(a*x)",
}


def test_every_function_of_the_language_is_tried():
    assert CALLS.keys() == FUNCTIONS.keys()


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_functions_agree_with_sympy(backend):
    model = model_of(*CALLS.values())
    # 11 points: one whole vector register and a rest, in two lanes.
    x = np.linspace(-2.5, 2.5, 11)
    p = np.array([[0.7, -1.3], [-0.4, 0.2]])
    y, yp = evaluated(model, backend, x, np.zeros(11), p)
    for k, channel in enumerate(model.outputs):
        expression = model.output(channel)
        for lane in range(2):
            for i, value in enumerate(x):
                at = {symbol("x"): value, symbol("a"): p[lane, 0], symbol("b"): p[lane, 1]}
                exact = float(expression.xreplace({s: sp.Float(v, 40) for s, v in at.items()}))
                # A rounding of the argument and one of the result, a few units in the last place.
                assert y[lane, k, i] == pytest.approx(exact, rel=2e-15, abs=1e-15), channel
    assert np.isfinite(yp).all()


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_a_derivative_at_a_kink_is_the_mean_of_its_two_sides(backend):
    texts = [
        "abs(a + x)",
        "positive(a + x)",
        "max(a, x)",
        "min(a, x)",
        "step(a + x)",
        "sign(a + x)",
    ]
    model = model_of(*texts, "a*b*w")
    p = np.array([[0.5, 1.0]])
    x = np.array([-0.5, 0.5])  # the kink of the sums, the kink of max and min
    y, yp = evaluated(model, backend, x, np.ones(2), p)
    np.testing.assert_array_equal(y[0, :6, 0], [0, 0, 0.5, -0.5, 0.5, 0])
    np.testing.assert_array_equal(yp[0, :6, 0, 0], [0, 0.5, 1, 0, 0, 0])
    np.testing.assert_array_equal(yp[0, 2:4, 0, 1], [0.5, 0.5])


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_the_slope_of_a_root_is_a_number_beyond_its_end(backend):
    """A tank whose level is tried below its bottom, as by a solver on its way, is no failure."""
    model = model_of("sqrt(positive(a + x))", "positive(a + x)**0.3", "sqrt(abs(a + x)) + 0*b*w")
    x = np.array([-2.0, -0.5, 3.5])  # beyond, at the end, inside
    y, yp = evaluated(model, backend, x, np.zeros(3), np.array([[0.5, 1.0]]))
    assert np.isfinite(yp).all()
    np.testing.assert_allclose(y[0, :2, 0], 0.0)
    np.testing.assert_allclose(yp[0, :2, 0, 0], 0.0)
    np.testing.assert_allclose(yp[0, 0, 0, 2], 0.25)


def test_the_fast_arctangent_is_good_to_the_last_bits():
    model = model_of("atan(a*x) + 0*b*w")
    rng = np.random.default_rng(2)
    x = rng.standard_normal(20_000) * 10 ** rng.uniform(-8, 8, 20_000)
    x[:8] = [0.0, 0.66, 2.414213562373095, 1.0, np.inf, -np.inf, np.nan, 1e-310]
    y, _ = evaluated(model, "numba", x, x, np.array([[1.0, 0.0]]))
    exact = np.arctan(x)
    assert np.isnan(y[0, 0, 6])
    good = ~np.isnan(x)
    np.testing.assert_allclose(y[0, 0, good], exact[good], rtol=5e-16, atol=0)


def test_nothing_finite_is_made_of_what_is_not():
    model = model_of(*(text for name, text in CALLS.items() if name not in ("step", "sign")))
    x = np.array([np.nan, 1.0])
    for backend in ("numpy", "numba"):
        y, _ = evaluated(model, backend, x, x, np.array([[0.7, -1.3]]))
        assert np.isnan(y[0, :, 0]).all()
        assert np.isfinite(y[0, :, 1]).all()


expressions = st.recursive(
    st.sampled_from(NAMES) | st.integers(-3, 3).map(str) | st.sampled_from(["0.5", "pi", "1e-3"]),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
        st.tuples(inner, inner).map(lambda t: f"({t[0]}/(1.5 + ({t[1]})**2))"),
        st.tuples(inner, st.integers(2, 5)).map(lambda t: f"({t[0]})**{t[1]}"),
        st.tuples(inner, st.sampled_from(["1.4", "-0.7", "b"])).map(
            lambda t: f"(1 + abs({t[0]}))**({t[1]})"
        ),
        st.tuples(
            st.sampled_from(["abs", "sign", "sin", "cos", "atan", "tanh", "positive", "step"]),
            inner,
        ).map(lambda t: f"{t[0]}({t[1]})"),
        st.tuples(st.sampled_from(["min", "max"]), inner, inner).map(
            lambda t: f"{t[0]}({t[1]}, {t[2]})"
        ),
    ),
    max_leaves=6,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(text=expressions, values=st.tuples(*[st.sampled_from([-1.7, -0.4, 0.3, 1.9])] * 4))
def test_random_expressions_agree_with_sympy(text, values):
    """Values against SymPy with 30 digits; derivatives against differences of those."""
    model = model_of(text)
    x, w, a, b = (np.array([v]) for v in values)
    y, yp = evaluated(model, "numpy", x, w, np.array([[a[0], b[0]]]))
    expression = model.output("y0")

    def exact(**moved: sp.Float) -> sp.Float:
        at = {name: sp.Float(v, 30) for name, v in zip(NAMES, values, strict=True)} | moved
        return sp.N(expression.xreplace({symbol(n): v for n, v in at.items()}), 30)

    value = float(exact())
    assume(abs(value) < 1e12)
    # Sums of a handful of terms may cancel; their size is not known here, so a floor of 1e-11.
    assert y[0, 0, 0] == pytest.approx(value, rel=1e-11, abs=1e-11)
    for k, name in enumerate("ab"):
        middle, small = sp.Float(values[2 + k], 30), sp.Float("1e-9", 30)
        ahead, behind = (exact(**{name: middle + sign * small}) for sign in (1, -1))
        right, left = (ahead - exact()) / small, (exact() - behind) / small
        assume(abs(right - left) < 1e-5 * (1 + abs(right)))  # not at a kink or a jump
        slope = float((ahead - behind) / (2 * small))
        assert yp[0, 0, k, 0] == pytest.approx(slope, rel=1e-8, abs=1e-8)


def test_lanes_left_out_are_left_alone():
    model = model_of("a*x", "b + w")
    made = kernels(model, backend="numba")
    u = np.ones((2, 5))
    y = np.full((4, 2, 5), 7.0)
    p = np.arange(8.0).reshape(4, 2)
    made.output(np.empty((4, 0, 5)), u, p, np.array([2, 0]), y)
    np.testing.assert_array_equal(y[[1, 3]], 7.0)
    np.testing.assert_array_equal(y[2, :, 0], [4.0, 6.0])


def test_a_kernel_split_into_loops_equals_the_whole():
    """More results than a compiled loop stores: the back ends agree on all of them."""
    texts = [f"sin({k}*a*x) + b*w*{k}" for k in range(1, 4)] + [
        f"{k}*atan(a*x) + a*b*w**{k}" for k in range(1, 15)
    ]
    x, w = np.linspace(-1, 1, 77), np.linspace(2, 3, 77)
    p = np.array([[0.3, 2.0], [-1.1, 0.4]])
    one = evaluated(model_of(*texts), "numpy", x, w, p)
    other = evaluated(model_of(*texts), "numba", x, w, p)
    for left, right in zip(one, other, strict=True):
        # Powers to the fourteenth of 3 are 5e6; the last bits of a dozen products differ.
        np.testing.assert_allclose(left, right, rtol=1e-13, atol=1e-13)


def test_kernels_are_made_once_and_kept_where_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path / "kernels"
    model = model_of("a*x + 0.123456789*b*w")
    first = kernels(model)
    assert kernels(model) is first
    assert not list(tmp_path.rglob("*.o"))  # each is made when it is asked for
    assert first.output.address == address_of(first.output.source)
    (code,) = (tmp_path / "kernels").glob("*.o")
    assert unsealed(code) is not None
    other = kernels(model, active=("b",))
    assert other.derived.active == ("b",)


def test_a_folder_that_cannot_be_written_costs_only_the_cache(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("BAYESOLEO_CACHE", str(blocked))
    assert cache_folder().is_dir()


def test_conditions_and_states_take_their_declared_places():
    model = thermomechanical_oleo(2)
    derived = kernels(model, backend="numpy").derived
    assert derived.orders == (2, 1)
    assert [s.name for s in derived.states] == [
        "stroke",
        "dot(stroke)",
        "ddot(stroke)",
        "temperature",
        "dot(temperature)",
    ]
    assert derived.constants == (*model.parameters, *model.conditions)
    assert isinstance(model.conditions["initial_pressure"], Condition)


@pytest.mark.parametrize("name", ["f16n2d2", "viscous_damper", "duffing"])
def test_kernels_fill_as_many_rows_as_they_say(name):
    derived = derive(system(name))
    assert {key: len(make()) for key, make in _results(derived).items()} == _counts(derived)


def test_numpy_computes_a_shared_subexpression_once():
    a, q = symbol("a"), symbol("q")
    shared = sp.sin(a * q)
    used, lines, results = statements([shared + q, 2 * shared, q], {a: "p0", q: "z0"})
    assert used == {a, q}
    assert sum("np.sin(" in line for line in lines) == 1
    scope = {"np": np, "p0": 0.3, "z0": np.array([1.0, -2.0])}
    exec("\n".join(lines), scope)
    sine = np.sin(0.3 * scope["z0"])
    for text, expected in zip(results, [sine + scope["z0"], 2 * sine, scope["z0"]], strict=True):
        np.testing.assert_allclose(eval(text, scope), expected, rtol=1e-15)


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_the_slope_of_the_size_of_a_power_is_real(backend):
    x, p = np.array([0.5, 1.5, 2.5]), np.array([[0.7, -1.3]])
    _, slope = evaluated(model_of("abs(b*x**a)"), backend, x, x, p)
    a, b = p[0]
    np.testing.assert_allclose(slope[0, 0, 0], abs(b) * x**a * np.log(x), rtol=1e-14)
    np.testing.assert_allclose(slope[0, 0, 1], np.sign(b) * x**a, rtol=1e-14)


def test_a_conjugate_of_what_is_real_is_itself():
    """Computer algebra writes one where it does not see that a power is real."""
    a, q = symbol("a"), symbol("q")
    kept = sp.conjugate(q**a)
    assert kept.has(sp.conjugate)
    _, lines, (result,) = statements([kept], {a: "p0", q: "z0"})
    scope = {"np": np, "p0": 1.5, "z0": np.array([1.0, 2.0])}
    exec("\n".join(lines), scope)
    np.testing.assert_allclose(eval(result, scope), [1.0, 2.0**1.5], rtol=1e-15)


SMALL = """
define void @kernel(ptr %z, ptr %u, ptr %p, ptr %out, i64 %count) {
entry:
  %constant = load double, ptr %p
  br label %loop
loop:
  %i = phi i64 [ 0, %entry ], [ %next, %loop ]
  %from = getelementptr double, ptr %z, i64 %i
  %to = getelementptr double, ptr %out, i64 %i
  %value = load double, ptr %from
  %sum = fadd double %value, %constant
  store double %sum, ptr %to
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %count
  br i1 %more, label %loop, label %end
end:
  ret void
}
"""
COMPILED = """
from bayesoleo._compiled import jit

@jit
def add(x):
    return x + 1.0
"""


def evaluate(source, monkeypatch):
    """A kernel of generated source, as a new process would load it."""
    monkeypatch.setattr("bayesoleo._machine_code._ADDRESSES", {})
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target_machine())
    monkeypatch.setattr("bayesoleo._machine_code._engine", lambda: engine)
    out = np.zeros((1, 1, 3))
    kernel = BlockKernel(source, 1)
    kernel(np.array([[[1.0, 2.0, 3.0]]]), np.zeros((0, 3)), np.array([[0.5]]), np.array([0]), out)
    return out.ravel().tolist()


def called(folder):
    """A function that Numba compiles, as a new process would load it."""
    spec = importlib.util.spec_from_file_location("compiled_for_a_test", folder / "compiled.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # Numba finds a function's globals by its module's name
    spec.loader.exec_module(module)
    return module.add(2.0)


def cut(content):
    return content[: len(content) // 2]


def flipped(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]


@pytest.fixture
def compiled(tmp_path, monkeypatch):
    """A folder with a module of compiled functions, beside which their code is kept."""
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path))
    # Numba's own setting would send its files elsewhere.
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    (tmp_path / "compiled.py").write_text(COMPILED)
    return tmp_path


@pytest.mark.parametrize("damage", [lambda _: b"", cut, flipped], ids=["empty", "cut", "flipped"])
def test_a_damaged_file_of_the_cache_is_made_anew(compiled, monkeypatch, damage):
    assert evaluate(SMALL, monkeypatch) == [1.5, 2.5, 3.5]
    assert called(compiled) == 3.0
    files = [path for path in compiled.rglob("*") if path.suffix in (".o", ".nbi", ".nbc")]
    assert {path.suffix for path in files} == {".o", ".nbi", ".nbc"}, "all of these are damaged"
    for path in files:
        path.write_bytes(damage(path.read_bytes()))
        assert unsealed(path) is None
    assert evaluate(SMALL, monkeypatch) == [1.5, 2.5, 3.5]
    assert called(compiled) == 3.0
    for path in files:
        assert unsealed(path) is not None
    assert not list(compiled.rglob("*.tmp"))


def test_a_full_disk_costs_only_the_cache(compiled, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("bayesoleo._machine_code.os.fsync", full)
    assert evaluate(SMALL, monkeypatch) == [1.5, 2.5, 3.5]
    assert called(compiled) == 3.0
    left = {path.name for path in compiled.rglob("*") if path.is_file()}
    assert left <= {"compiled.py", "compiling.lock"}  # a lock is empty


def test_a_cache_that_was_moved_is_used_where_it_is(tmp_path, monkeypatch):
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path / "a"))
    assert evaluate(SMALL, monkeypatch) == [1.5, 2.5, 3.5]
    shutil.move(tmp_path / "a", tmp_path / "b")
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path / "b"))
    monkeypatch.setattr("bayesoleo._machine_code._compiled", None)  # nothing is compiled again
    assert evaluate(SMALL, monkeypatch) == [1.5, 2.5, 3.5]


def test_a_kernel_is_pickled_with_its_instructions_and_without_its_address():
    kernel = BlockKernel(lambda: SMALL, 1)
    assert kernel.address == address_of(SMALL)
    other = pickle.loads(pickle.dumps(kernel))
    assert (other.source, other.rows) == (SMALL, 1)
    assert "address" not in vars(other)


def test_instructions_of_the_library_are_those_of_numpy():
    """Of two numbers, also where one is none."""
    numbers = np.array([-1.5, -0.0, 0.0, 2.0, np.inf, -np.inf, np.nan])
    one, other = (part.ravel() for part in np.meshgrid(numbers, numbers))
    model = model_of("max(x, w)", "min(x, w)", "sign(x)", "abs(x)")
    y, _ = evaluated(model, "numba", one, other, np.array([[1.0, 1.0]]))
    expected = [np.maximum(one, other), np.minimum(one, other), np.sign(one), np.abs(one)]
    np.testing.assert_array_equal(y[0], expected)


def test_what_is_the_same_at_all_points_is_computed_once():
    source = kernels(model_of("exp(a)*x")).output.source
    assert "@c_exp" in source[: source.index("loop:")]


def test_a_function_that_computer_algebra_brings_in():
    """A shifted tangent is written as a cotangent; what is none of the language is refused."""
    x = np.array([-0.4, 0.3, 1.1])
    for backend in ("numba", "numpy"):
        y, _ = evaluated(model_of("tan(x + 1.5*a)"), backend, x, x, np.array([[np.pi / 3, 1.0]]))
        np.testing.assert_allclose(y[0, 0], np.tan(x + np.pi / 2), rtol=1e-13)
    derived = derive(model_of("a*x"))
    q = symbol("x")
    shifted = machine_code([sp.tan(q + sp.pi / 2)], derived)
    assert "fdiv" in shifted
    with pytest.raises(ModelError, match=r"Piecewise is not a function of equations"):
        machine_code([sp.Piecewise((q, q > 0), (0, True))], derived)


def test_a_ratio_of_two_numbers_near_zero_is_a_number():
    tiny = np.array([1e-310, 3e-310])
    y, _ = evaluated(model_of("x/w"), "numba", tiny, tiny[::-1], np.array([[1.0, 1.0]]))
    np.testing.assert_allclose(y[0, 0], [1 / 3, 3.0], rtol=1e-12)


@pytest.mark.parametrize("count", [1, 3, 48, 64])
def test_rows_that_are_the_same_at_all_points_are_written_apart_where_rows_are_many(count):
    """With each value in its row, and nothing beyond the points that are asked for. Written point
    by point, hundreds of rows push each other out of the cache."""
    rng = np.random.default_rng(11)
    derived = derive(model_of("a*x + b*w"))
    x, w, a, b = (symbol(name) for name in NAMES)
    shapes = [sp.Integer(0), sp.Integer(1), a, a * b, x, a * x * w, sp.Float(-2.5)]
    items = [shapes[k] for k in rng.integers(len(shapes), size=MANY_ROWS + 33)]
    moving = sum(item.has(x) or item.has(w) for item in items)
    source = machine_code(items, derived)
    assert source[source.index("\nloop:") :].count("store") == moving
    u = np.zeros((len(derived.inputs), BLOCK))
    table = {row: k for k, row in enumerate(derived.inputs)}
    u[:] = rng.standard_normal(u.shape)
    p = np.array([{"a": 0.7, "b": -1.3}[name] for name in derived.constants])
    out = np.full((len(items), BLOCK), np.nan)
    signature = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4, ctypes.c_ssize_t)
    signature(address_of(source))(None, *[part.ctypes.data for part in (u, p, out)], count)
    assert np.isnan(out[:, count:]).all()
    known = dict(zip((symbol(name) for name in derived.constants), p, strict=True))
    for row, item in enumerate(items):
        at = {symbol(name): u[k] for (name, _), k in table.items()}
        function = sp.lambdify(list(at), item.subs(known))
        expected = np.broadcast_to(function(*at.values()), BLOCK)[:count]
        np.testing.assert_allclose(out[row, :count], expected, rtol=1e-14)
