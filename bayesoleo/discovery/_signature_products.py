"""Products of the signatures of all effects in the fitted runs, one run after the other.

They are all that the evidence of more than noise asks of signatures. Those of one run are put side
by side in one table, multiplied, and written over by those of the next run: together they would
take hundreds of megabytes. A signature that is zero in a run, as that of another run's own unknown,
has no row in its table.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.error_models._base import Frame
from bayesoleo.error_models._catalogue_evidence import CatalogueEvidence, SignatureProducts, Smooth
from bayesoleo.error_models._correlated import whitened
from bayesoleo.error_models._signatures import Rows, Signatures

#: What one signature is in each run that it has values for, shape (s, n), in the outputs' units.
Column = Mapping[str, Array]


@dataclass(frozen=True)
class UnitProducts:
    """Products of ``k`` signatures in units of the noise.

    Parameters
    ----------
    present : sequence of ndarray of int, shape (p,)
        By run, signatures that are not zero in it.
    grams : sequence of ndarray, shape (s, p, p)
        By run, of these with each other in each output.
    whole : ndarray, shape (k,)
        Squared lengths over all runs and outputs.
    beside : ndarray, shape (k, k)
        Products over all runs and outputs of what is left beside the model's parameters.
    """

    present: Sequence[Integers]
    grams: Sequence[Array]
    whole: Array
    beside: Array

    @classmethod
    def of(cls, fit: ModelFit, sigma: Array, columns: Sequence[Column]) -> UnitProducts:
        """Of columns beside what a fit estimates, with the outputs' noise ``sigma (s,)``."""
        axes, share = _axes(_sensitivity(fit, sigma))
        present, grams, first = _present(fit, columns), [], 0
        total, cross = np.zeros((len(columns),) * 2), np.zeros((len(columns), len(axes)))
        for own, table in _tables(fit, columns, np.ones(len(columns)), sigma, present):
            # A product of a table with itself takes half the work.
            gram = np.stack([rows @ rows.T for rows in table])
            for rows in table:
                last = first + rows.shape[1]
                cross[own] += rows @ axes[:, first:last].T
                first = last
            total[np.ix_(own, own)] += gram.sum(axis=0)
            grams.append(gram)
        return cls(present, grams, np.diag(total).copy(), total - (cross * share) @ cross.T)

    def keeping(self, kept: Flags, scale: Array) -> UnitProducts:
        """Of some of the signatures, kept (k,), each times a factor; scale is of all, (k,)."""
        place, present, grams = np.cumsum(kept) - 1, [], []
        for own, gram in zip(self.present, self.grams, strict=True):
            stays = kept[own]
            factor = scale[own[stays]]
            present.append(place[own[stays]])
            # One factor at a time: the square of one may be beyond all numbers.
            grams.append(gram[:, stays][:, :, stays] * factor[:, None] * factor)
        factor = scale[kept]
        beside = self.beside[np.ix_(kept, kept)] * factor[:, None] * factor
        return UnitProducts(present, grams, self.whole[kept] * factor * factor, beside)

    def evidence(
        self,
        fit: ModelFit,
        signatures: Signatures,
        columns: Sequence[Column],
        scale: Array,
        rows: Sequence[Sequence[Array]],
    ) -> tuple[CatalogueEvidence, list[Rows]]:
        """Evidence of the signatures, and rows as it needs them.

        Parameters
        ----------
        fit : ModelFit
        signatures : Signatures
            These, without samples.
        columns : sequence of Column, length k
        scale : ndarray, shape (k,)
            Factors of the columns; the products have them.
        rows : sequence over runs of sequence over outputs of ndarray, shape (q, n)
            Whose products are asked for.
        """
        samples, noise = Frame.of(fit.problem).sampled(), signatures.noise
        smooth = [[Smooth.of(run, colour) for colour in signatures.colour] for run in samples]
        products, crossed = [], []
        tables = _tables(fit, columns, scale, noise, self.present)
        for r, (own, table) in enumerate(tables):
            products.append(list[SignatureProducts]())
            for b, colour in enumerate(signatures.colour):
                asked = whitened(np.ascontiguousarray(rows[r][b]), samples[r].time, *colour)[0]
                asked = asked / noise[b]
                white, gram = table[b], self.grams[r][b]
                if colour[0] > 0:
                    white = whitened(white, samples[r].time, *colour)[0]
                    gram = white @ white.T
                basis = smooth[r][b].basis
                products[r].append(SignatureProducts(own, gram, white @ basis))
                crossed.append((r, b, asked, asked @ basis, asked @ white.T))
        found = CatalogueEvidence.of(products, smooth, signatures)
        turned = [
            found.rows(r, b, asked, along, cross @ found.rotation[self.present[r]])
            for r, b, asked, along, cross in crossed
        ]
        return found, turned


def _present(fit: ModelFit, columns: Sequence[Column]) -> list[Integers]:
    """By run, which columns have values other than zero."""
    labels = [record.label for record in fit.records]
    return [
        np.flatnonzero([bool(label in column and column[label].any()) for column in columns])
        for label in labels
    ]


def _tables(
    fit: ModelFit,
    columns: Sequence[Column],
    scale: Array,
    sigma: Array,
    present: Sequence[Integers],
) -> Iterator[tuple[Integers, Array]]:
    """By run, which columns are in its table, and the table (s, p, n) in units of the noise.

    The next table is written over it.
    """
    outputs, counts = len(sigma), fit.problem.counts[:, 0]
    sizes = [outputs * own.size * int(count) for own, count in zip(present, counts, strict=True)]
    room = np.empty(max(sizes, default=0))
    for record, own, count, size in zip(fit.records, present, counts, sizes, strict=True):
        table = room[:size].reshape(outputs, own.size, int(count))
        for place, k in enumerate(own):
            factor = (scale[k] / sigma)[:, None]
            np.multiply(columns[k][record.label], factor, out=table[:, place])
        yield own, table


def _sensitivity(fit: ModelFit, sigma: Array) -> Array:
    """Sensitivities of the model's unknowns in units of the noise, of unit length, (l, n): all
    outputs of a run one after the other, run by run."""
    names = fit.predictor.layout.names
    free = [names.index(name) for name in fit.problem.names]
    parts = []
    for r in range(len(fit.records)):
        own = fit.problem.kept(r, fit.predictions[r].sensitivity[:, free])
        own = own / sigma[:, None, None]
        parts.append(own.swapaxes(0, 1).reshape(len(free), -1))
    table = np.concatenate(parts, axis=1)
    norm = np.linalg.norm(table, axis=1, keepdims=True)
    return np.asarray(table / np.where(norm > 0, norm, 1.0))


def _axes(sensitivity: Array) -> tuple[Array, Array]:
    """Orthonormal rows (l, n) that sensitivities span, and how much of a product along each of them
    the parameters take away, (l,): less than all where they do not determine it to the last digit,
    as :func:`~bayesoleo.discovery._score_basis.coefficients` holds it back."""
    _, size, axes = np.linalg.svd(sensitivity, full_matrices=False)
    squares = size**2
    floor = 10 * len(squares) * np.finfo(float).eps * max(squares.max(initial=0.0), 1e-300)
    part = squares / np.maximum(squares, floor)
    return axes, 2 * part - part**2
