/* The library of the original, found beside the own one, and its functions. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define INSIDE "resources/original/" /* of the unpacked FMU */
#define LONGEST_PATH 4096

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>

static void *open_library(const char *reserve, char *reason, size_t size)
{
    static const wchar_t inside[] = L"" INSIDE ORIGINAL;
    wchar_t path[LONGEST_PATH];
    HMODULE own = NULL;
    (void)reserve;
    GetModuleHandleExW(GET_MODULE_HANDLE_EX_FLAG_FROM_ADDRESS | GET_MODULE_HANDLE_EX_FLAG_UNCHANGED_REFCOUNT,
                       (LPCWSTR)(void *)open_library, &own);
    DWORD length = GetModuleFileNameW(own, path, LONGEST_PATH);
    for (int up = 0; up < 3; up++) /* out of binaries/PLATFORM */
        while (length > 0 && path[--length] != L'\\' && path[length] != L'/') {}
    if (length + 2 + sizeof inside / sizeof inside[0] > LONGEST_PATH) return NULL;
    path[length] = L'\\';
    wcscpy(path + length + 1, inside);
    for (wchar_t *c = path; *c; c++) if (*c == L'/') *c = L'\\';
    HMODULE library = LoadLibraryExW(path, NULL, LOAD_WITH_ALTERED_SEARCH_PATH);
    if (library == NULL) snprintf(reason, size, "%s%s: Windows error %lu", INSIDE, ORIGINAL, (unsigned long)GetLastError());
    return library;
}

static void *symbol_of(void *library, const char *name)
{
    return (void *)GetProcAddress((HMODULE)library, name);
}

static void close_library(void *library)
{
    FreeLibrary((HMODULE)library);
}
#else
#include <dlfcn.h>

#ifndef RTLD_DEEPBIND
#define RTLD_DEEPBIND 0
#endif

/* How the original is loaded: with its own symbols first, unless the host replaces an allocator or checks memory. */
static int scope(void)
{
    return getenv("LD_PRELOAD") ? RTLD_LOCAL : RTLD_LOCAL | RTLD_DEEPBIND;
}

/* The folder of the unpacked FMU by the place of this library; 0 if it is unknown. */
static int own_folder(char *path)
{
    Dl_info here;
    if (!dladdr((void *)SYMBOLS, &here) || here.dli_fname == NULL || strlen(here.dli_fname) >= LONGEST_PATH) return 0;
    strcpy(path, here.dli_fname);
    for (int up = 0; up < 3; up++) {
        char *slash = strrchr(path, '/');
        if (slash == NULL) return 0;
        *slash = '\0';
    }
    return 1;
}

/* The folder by the resources, a path or a URI. */
static int folder_of_resources(const char *resources, char *path)
{
    size_t n = 0;
    if (resources == NULL) return 0;
    if (strncmp(resources, "file://", 7) == 0) {
        resources += 7;
        if (strncmp(resources, "localhost/", 10) == 0) resources += 9;
    } else if (strncmp(resources, "file:", 5) == 0) resources += 5;
    for (const char *c = resources; *c && n + 1 < LONGEST_PATH; c++) {
        unsigned code;
        if (*c == '%' && sscanf(c + 1, "%2x", &code) == 1) path[n++] = (char)code, c += 2;
        else path[n++] = *c;
    }
    while (n > 0 && path[n - 1] == '/') n--;
    path[n] = '\0';
    char *slash = strrchr(path, '/');
    if (slash == NULL) return 0;
    *slash = '\0';
    return 1;
}

static int is_file(const char *path)
{
    FILE *file = fopen(path, "rb");
    if (file == NULL) return 0;
    fclose(file);
    return 1;
}

static void *open_library(const char *resources, char *reason, size_t size)
{
    char folder[LONGEST_PATH], path[LONGEST_PATH + sizeof INSIDE ORIGINAL + 1];
    int is_found = 0;
    for (int by_resources = 0; by_resources < 2 && !is_found; by_resources++) {
        if (!(by_resources ? folder_of_resources(resources, folder) : own_folder(folder))) continue;
        snprintf(path, sizeof path, "%s/%s%s", folder, INSIDE, ORIGINAL);
        is_found = is_file(path);
    }
    if (!is_found) {
        snprintf(reason, size, "%s%s is not in the unpacked FMU", INSIDE, ORIGINAL);
        return NULL;
    }
    void *library = dlopen(path, RTLD_NOW | scope());
    if (library != NULL) return library;
    snprintf(reason, size, "%s", dlerror());
#ifdef __linux__
    dlopen("libm.so.6", RTLD_NOW | RTLD_GLOBAL); /* some originals leave the mathematics to the host */
    if ((library = dlopen(path, RTLD_NOW | scope())) != NULL) return library;
#endif
    return dlopen(path, RTLD_LAZY | scope()); /* some have functions that nobody calls */
}

static void *symbol_of(void *library, const char *name)
{
    return dlsym(library, name);
}

static void close_library(void *library)
{
    dlclose(library);
}
#endif

static void find_functions(void *library, Functions *functions)
{
    for (size_t k = 0; k < sizeof SYMBOLS / sizeof SYMBOLS[0]; k++) {
        void *function = symbol_of(library, SYMBOLS[k].name);
        memcpy((char *)functions + SYMBOLS[k].place, &function, sizeof function);
    }
}

/* The original's resources by the host's; NULL if there is no memory. */
static char *resources_of_original(const char *resources, const char *end)
{
    size_t size = strlen(resources);
    char *text = malloc(size + sizeof "/original/resources/");
    if (text == NULL) return NULL;
    while (size > 0 && (resources[size - 1] == '/' || resources[size - 1] == '\\')) size--;
    memcpy(text, resources, size);
    sprintf(text + size, "/original/resources%s", end);
    return text;
}
