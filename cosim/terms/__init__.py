"""General catalogue of terms that an FMU may lack; each term is bound to every place where it can act.

A user's own terms are subclasses in a file (`terms: my_terms.py` in a study):

    from cosim.terms import Force, scaled

    class Windage(Force):
        kind = "windage"
        equation = "−c·v³"
        coefficient: float = scaled("u/v^3", neutral=0.0, typical=0.1, low=0.0, doc="coefficient c")

        def force(self, m, position, velocity):
            return -self.coefficient * velocity**3
"""

from cosim.terms.language import Force, InputTerm, RateTerm, Term, scaled

__all__ = ["Force", "InputTerm", "RateTerm", "Term", "scaled"]
