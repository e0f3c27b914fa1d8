"""Sums over the pixels of windows that hold several columns, LANES windows at a time, and the equations made of them.

The model is the sum of A_i E_i over the members of a group, and a background. Shapes are known, so the derivatives of a
member are E_i times 1, dx and dy, with distances from its own centre. The products of two members' derivatives are
sums of E_i E_j dx^p dy^q up to order 2, about the centre of the first. A member's image E_i is made once a step; the
sums of a pair are those of a product of two images.

Pixels that do not count, or are missing, are 0 in every image. The functions are traced, see
:func:`~tract_dask.kernels.vectors.tracing.traced`; blocks, images and sums are rows of LANES float32. Symmetric
matrices hold their lower triangle, row by row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ..vectors.tracing import Index, Rows, Vector, absolute, exp, larger, loop, select, spread, sqrt, traced

HEIGHT, X, Y, A, B, C, LOWER, UPPER, TRIAL, REACH, N_MEMBER = 0, 1, 2, 3, 4, 5, 6, 9, 12, 15, 16
"""Rows of a member: amplitude, centre, and the exponent (a X^2 + 2 b X Y + c Y^2) / 2; bounds of amplitude, x and y;
the trial's amplitude, x and y; the longest step, px. Centres are in px from the window's middle pixel."""

N_ALONE, N_PAIR, N_DATA = 4, 6, 6
"""Sums of a member's E: times 1, X, Y, and times the pixels. Of a pair's E_i E_j, and of E times the residual: times 1,
X, Y, X^2, X Y, Y^2."""

_FLOOR = 1e-18  # E below this is 0, so that products are not subnormal numbers, which are slow
_LEAST_VARIANCE = 0.02  # of the brightest: a pixel has at least so much of the noise


class Window(NamedTuple):
    """The pixels of a window; sizes are integers."""

    height: Any
    width: Any
    pixels: Any
    """(height * width,) rows."""
    weights: Any
    """(height * width,) rows: 1 where a pixel counts, 0 elsewhere."""


def _summed(window: Any, n: tuple[int, int], body: Any) -> list[Vector]:
    """Return sums over all pixels: ``body(y)`` returns what a pixel adds to those of its row, and what these become.

    ``n`` are the numbers of sums of a row, and of the window.
    """
    zero, none = window.height.constant(0), window.pixels.constant(0)

    def row(y: Index, totals: list[Vector]) -> list[Vector]:
        pixel, of_row = body(y)

        def add(x: Index, values: list[Vector]) -> list[Vector]:
            return [value + more for value, more in zip(values, pixel(y * window.width + x, x), strict=True)]

        sums = of_row(loop(zero, window.width, [none] * n[0], add))
        return [total + more for total, more in zip(totals, sums, strict=True)]

    return loop(zero, window.height, [none] * n[1], row)


def _write(values: list[Vector], into: Rows) -> None:
    for k, value in enumerate(values):
        into[k] = value


def _from_centre(window: Any, centre: Rows) -> Any:
    """Return functions from a column and from a row to their distance from a centre (x, y)."""
    x, y = centre[0] + spread(window.width // 2), centre[1] + spread(window.height // 2)
    return lambda column: spread(column) - x, lambda line: spread(line) - y


def _of_products(window: Any, centre: Rows, product: Any) -> list[Vector]:
    """Return the sums of a product of images times 1, X, Y, X^2, X Y, Y^2."""
    across, down = _from_centre(window, centre)

    def body(y: Index) -> Any:
        dy = down(y)

        def pixel(k: Index, x: Index) -> list[Vector]:
            dx, value = across(x), product(k)
            return [value, value * dx, value * dx * dx]

        return pixel, lambda s: [s[0], s[1], s[0] * dy, s[2], s[1] * dy, s[0] * dy * dy]

    return _summed(window, (3, 6), body)


@traced()
def member_image(window: Any, centre: Rows, exponent: Rows, image: Rows, sums: Rows) -> None:
    """Write E at a centre, with a, b, c of its exponent, and its sums (N_ALONE,)."""
    across, down = _from_centre(window, centre)
    a, b, c = exponent[0], exponent[1], exponent[2]

    def body(y: Index) -> Any:
        dy = down(y)
        level, slope = -0.5 * c * dy * dy, b * dy

        def pixel(k: Index, x: Index) -> list[Vector]:
            dx = across(x)
            e = exp(level - dx * (0.5 * a * dx + slope))
            e = select(e > _FLOOR, e * window.weights[k], 0)
            image[k] = e
            return [e, e * dx, e * window.pixels[k]]

        return pixel, lambda s: [s[0], s[1], s[0] * dy, s[2]]

    _write(_summed(window, (3, N_ALONE), body), sums)


@traced()
def pair_sums(window: Any, centre: Rows, one: Rows, other: Rows, sums: Rows) -> None:
    """Write the sums (6,) of the product of two images about a centre."""
    _write(_of_products(window, centre, lambda k: one[k] * other[k]), sums)


@traced()
def begin_residual(window: Any, background: Vector, residual: Rows) -> None:
    """Write the pixels less the background."""

    def subtract(k: Index, _: list[Vector]) -> list[Vector]:
        residual[k] = window.pixels[k] - background * window.weights[k]
        return []

    loop(window.height.constant(0), window.height * window.width, [], subtract)


@traced()
def add_image(window: Any, factor: Vector, image: Rows, into: Rows) -> None:
    """Add an image times a factor to another."""

    def add(k: Index, _: list[Vector]) -> list[Vector]:
        into[k] = into[k] + factor * image[k]
        return []

    loop(window.height.constant(0), window.height * window.width, [], add)


@traced()
def total_and_squares(window: Any, image: Rows, totals: Rows) -> None:
    """Write the sums of an image and of its squares."""

    def body(y: Index) -> Any:
        return lambda k, x: [image[k], image[k] * image[k]], lambda s: s

    _write(_summed(window, (2, 2), body), totals)


@traced()
def noise_image(window: Any, level: Vector, image: Rows) -> None:
    """Replace the expected counts of the pixels by the noise's standard deviation, for variance 1 at ``level``.

    Where the level is not above zero the noise is 1 in all pixels.
    """

    def root(k: Index, _: list[Vector]) -> list[Vector]:
        variance = select(level > 0, larger(image[k] / level, _LEAST_VARIANCE), 1)
        image[k] = sqrt(variance) * window.weights[k]
        return []

    loop(window.height.constant(0), window.height * window.width, [], root)


@traced()
def multiply(window: Any, image: Rows, by: Rows) -> None:
    """Multiply an image by another."""

    def product(k: Index, _: list[Vector]) -> list[Vector]:
        image[k] = image[k] * by[k]
        return []

    loop(window.height.constant(0), window.height * window.width, [], product)


def _derivatives(member: Rows, apart: Any = None) -> list[list[Any]]:
    """Return a member's derivatives by amplitude, x and y, over E: factors of 1, dx, dy about a place.

    ``apart`` is that place less the member's centre; None: it is the centre.
    """
    amplitude, a, b, c = member[HEIGHT], member[A], member[B], member[C]
    found: list[list[Any]] = [[a.of(1), None, None]]
    for along, across in ((a, b), (b, c)):
        level = None if apart is None else amplitude * (along * apart[0] + across * apart[1])
        found.append([level, amplitude * along, amplitude * across])
    return found


def _product(one: list[Any], other: list[Any], sums: Any) -> Any:
    """Return the sum of the product of two derivatives, given the sums times 1, X, Y, X^2, X Y, Y^2."""
    place = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    pairs = [(p, q, place[i][j]) for i, p in enumerate(one) for j, q in enumerate(other)]
    total, *others = [p * q * sums[k] for p, q, k in pairs if p is not None and q is not None]
    for value in others:
        total = total + value
    return total


def _entry(row: Index, column: Index) -> Index:
    return row * (row + 1) // 2 + column


@traced()
def own_block(member: Rows, sums: Rows, number: Index, matrix: Rows) -> None:
    """Write the products of a member's derivatives among themselves."""
    by = _derivatives(member)
    for q in range(3):
        for p in range(q + 1):
            matrix[_entry(number * 3 + q, number * 3 + p)] = _product(by[p], by[q], sums)


@traced()
def pair_block(one: Rows, other: Rows, sums: Rows, first: Index, second: Index, matrix: Rows) -> None:
    """Write the products of the derivatives of two members, of which ``second`` is the higher number."""
    by_one, by_other = _derivatives(one), _derivatives(other, (one[X] - other[X], one[Y] - other[Y]))
    for q in range(3):
        for p in range(3):
            matrix[_entry(second * 3 + q, first * 3 + p)] = _product(by_one[p], by_other[q], sums)


@traced()
def background_block(member: Rows, sums: Rows, number: Index, row: Index, matrix: Rows) -> None:
    """Write the products of a member's derivatives with that by the background, which has the last ``row``."""
    by = _derivatives(member)
    matrix[_entry(row, number * 3)] = sums[0]
    for p in (1, 2):
        matrix[_entry(row, number * 3 + p)] = by[p][1] * sums[1] + by[p][2] * sums[2]


@traced()
def residual_sums(window: Any, centre: Rows, image: Rows, residual: Rows, sums: Rows) -> None:
    """Write the sums (N_DATA,) of E times the residual."""
    _write(_of_products(window, centre, lambda k: image[k] * residual[k]), sums)


@traced()
def gradient_block(member: Rows, data: Rows, number: Index, gradient: Rows, newton: Rows) -> None:
    """Write the gradient of half the residual's sum of squares; take the second derivatives off J^T J."""
    a, b, c = member[A], member[B], member[C]
    by_x, by_y = _derivatives(member)[1:]
    first = number * 3
    gradient[first] = -data[0]
    slopes = [by[1] * data[1] + by[2] * data[2] for by in (by_x, by_y)]
    for k, slope in enumerate(slopes):
        gradient[first + 1 + k] = -slope
    amplitude = member[HEIGHT]
    inverse = select(absolute(amplitude) > 1e-20, 1 / amplitude, 0)
    second = {
        (1, 0): slopes[0] * inverse,
        (2, 0): slopes[1] * inverse,
        (1, 1): _product(by_x, by_x, data) * inverse - amplitude * a * data[0],
        (2, 1): _product(by_x, by_y, data) * inverse - amplitude * b * data[0],
        (2, 2): _product(by_y, by_y, data) * inverse - amplitude * c * data[0],
    }
    for (row, column), value in second.items():
        place = _entry(first + row, first + column)
        newton[place] = newton[place] - value
