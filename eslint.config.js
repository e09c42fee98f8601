import js from "@eslint/js";
import globals from "globals";

export default [
  { ignores: ["**/.venv/", "build/", "docs/_*", "results/"] },
  js.configs.recommended,
  {
    files: ["{cosim,plant,controller,fmus}/**/*.js"],
    languageOptions: { sourceType: "script", globals: globals.browser },
    rules: { "no-var": "error", "prefer-const": "error", eqeqeq: ["error", "smart"], complexity: ["error", 20] },
  },
];
