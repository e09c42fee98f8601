// Scores of the search: the section of a verb in cli.md comes first.
var Scorer = {
  score: ([page, , , , score, , kind]) => (page === "cli" && kind === "title" ? score + 100 : score),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
