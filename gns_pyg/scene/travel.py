"""How far a moving boundary part has come. Runs in Yade's Python too: the standard library only.

Functions of time are arithmetic in `t` with the functions in FUNCTIONS; nothing else is read, so that a scene file
cannot run code. They are analytic, which makes the speed exact too (see `scene.motion`).
"""

import ast
import math
import operator
from typing import Any

FUNCTIONS = ("sin", "cos", "tan", "tanh", "exp", "sqrt")
FUNCTION = f"arithmetic (+ - * / **) in t with numbers, pi and {', '.join(FUNCTIONS)}"
OPERATORS: dict[type, Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
MOST_POWER = 32  # whole exponents up to this one are multiplied out
LONGEST = 200  # characters of a function


def travel(motion: Any, t: Any, library: Any) -> Any:
    """The angle, rad, of a rotation, or the way, m, of a translation or oscillation, at time `t`, s.

    Args:
        motion: a `scene.Motion`, or anything with its attributes.
        t: what `library` computes with: a float, an array, a tensor (complex ones too).
        library: the module that has sin, cos, ...: math, numpy or torch.

    Raises:
        ValueError: for a function that is more than FUNCTION says.
    """
    if motion.function is not None:
        return _evaluate(motion.function, t, library)
    if motion.kind == "oscillation":
        return motion.amplitude_m * library.sin(2 * 3.141592653589793 * motion.frequency_hz * t)
    return (motion.rate_rad_s if motion.kind == "rotation" else motion.speed_m_s) * t


def _power(base: Any, exponent: int) -> Any:
    """By multiplication: a complex logarithm would spoil the speed of a negative base (see `scene.motion`)."""
    result = 1.0
    for _ in range(abs(exponent)):
        result = result * base
    return result if exponent >= 0 else 1 / result


def _evaluate(text: str, t: Any, library: Any) -> Any:
    if len(text) > LONGEST:
        raise ValueError(f"{len(text)} characters, at most {LONGEST}")
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except SyntaxError as error:
        raise ValueError(error.msg) from None
    return _value(tree.body, {"t": t, "pi": 3.141592653589793}, library)


def _value(node: ast.AST, names: dict[str, Any], library: Any) -> Any:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.Name) and node.id in names:
        return names[node.id]
    if isinstance(node, ast.UnaryOp) and type(node.op) in OPERATORS:
        return OPERATORS[type(node.op)](_value(node.operand, names, library))
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        left, right = (_value(side, names, library) for side in (node.left, node.right))
        if (
            isinstance(node.op, ast.Pow)
            and isinstance(right, float)
            and right.is_integer()
            and abs(right) <= MOST_POWER
        ):
            return _power(left, int(right))
        return OPERATORS[type(node.op)](left, right)
    called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
    if isinstance(node, ast.Call) and called in FUNCTIONS and len(node.args) == 1 and not node.keywords:
        value = _value(node.args[0], names, library)
        return getattr(math if isinstance(value, float) else library, called)(value)  # torch takes no numbers
    raise ValueError(f"cannot read {ast.unparse(node)}")
