//! The import graph between the files of one crate, read from the source by `syn`.
//!
//! A node is a module that has a file of its own. An edge goes from a file to the file that defines what it names. Re-exports
//! (`pub use child::Item`) are resolved to the defining file and are no imports of the module that re-exports. Test modules and
//! items under `#[cfg(test)]` are left out.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use proc_macro2::{TokenStream, TokenTree};
use quote::ToTokens;
use syn::{Attribute, Item, UseTree, Visibility};

/// A module's path within its crate; the root's is empty.
pub(crate) type Module = Vec<String>;

/// Which file imports from which.
pub(crate) type Graph = BTreeMap<Module, BTreeSet<Module>>;

/// Names that a module re-exports, with the full path of each.
type Reexports = BTreeMap<Module, BTreeMap<String, Vec<String>>>;

/// The import graph of the crate whose sources lie in `src`.
pub(crate) fn graph(src: &Path) -> Graph {
    let mut files = BTreeMap::new();
    for path in sources(src) {
        let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let file = syn::parse_file(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        files.insert(module_of(src, &path), file.items);
    }
    graph_of(&files)
}

fn graph_of(files: &BTreeMap<Module, Vec<Item>>) -> Graph {
    // A test module in a file of its own is declared behind `#[cfg(test)]` by its parent.
    let declared_for_tests: BTreeSet<Module> = files
        .iter()
        .flat_map(|(module, items)| items.iter().map(move |item| (module, item)))
        .filter_map(|(module, item)| match item {
            Item::Mod(inner) if is_test(&inner.attrs) => Some(child(module, &inner.ident.to_string())),
            _ => None,
        })
        .collect();
    let is_tested = |module: &Module| (1..=module.len()).any(|depth| declared_for_tests.contains(&module[..depth]));
    let modules: BTreeSet<Module> = files.keys().filter(|module| !is_tested(module)).cloned().collect();

    let (mut named, mut reexports): (BTreeMap<Module, Vec<Vec<String>>>, Reexports) = Default::default();
    for module in &modules {
        let mut paths = Paths { modules: &modules, module, named: Vec::new(), reexported: BTreeMap::new() };
        paths.read(&files[module], module);
        named.insert(module.clone(), paths.named);
        reexports.insert(module.clone(), paths.reexported);
    }
    let imports = |module: &Module, paths: Vec<Vec<String>>| -> BTreeSet<Module> {
        let defining = paths.iter().map(|path| defining_file(path, &modules, &reexports, 0));
        defining.filter(|file| file != module).collect()
    };
    named.into_iter().map(|(module, paths)| (module.clone(), imports(&module, paths))).collect()
}

/// The strongly connected parts of more than one file: each is a ring of imports.
pub(crate) fn rings(graph: &Graph) -> Vec<Vec<Module>> {
    let reached: BTreeMap<&Module, BTreeSet<&Module>> =
        graph.keys().map(|from| (from, reachable(graph, from))).collect();
    let mut left: BTreeSet<&Module> = graph.keys().collect();
    let mut rings = Vec::new();
    while let Some(first) = left.pop_first() {
        let in_ring = |other: &&&Module| reached[first].contains(**other) && reached[**other].contains(first);
        let others: Vec<&Module> = left.iter().filter(in_ring).copied().collect();
        if !others.is_empty() {
            others.iter().for_each(|other| {
                left.remove(other);
            });
            rings.push(std::iter::once(first).chain(others).cloned().collect());
        }
    }
    rings
}

fn reachable<'a>(graph: &'a Graph, from: &Module) -> BTreeSet<&'a Module> {
    let mut open: Vec<&Module> = graph[from].iter().collect();
    let mut seen = BTreeSet::new();
    while let Some(module) = open.pop() {
        if seen.insert(module) {
            open.extend(&graph[module]);
        }
    }
    seen
}

fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.expect("a readable folder").path()).collect();
    paths.sort();
    let read = |path: PathBuf| match path.extension() {
        _ if path.is_dir() => sources(&path),
        Some(extension) if extension == "rs" => vec![path],
        _ => Vec::new(),
    };
    paths.into_iter().flat_map(read).collect()
}

fn module_of(src: &Path, file: &Path) -> Module {
    let relative = file.strip_prefix(src).expect("a file below src").with_extension("");
    let mut module: Module = relative.iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if module.last().is_some_and(|last| last == "mod") || [["lib"], ["main"]].iter().any(|root| module == *root) {
        module.pop();
    }
    module
}

fn child(module: &[String], name: &str) -> Module {
    module.iter().cloned().chain([name.to_owned()]).collect()
}

fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg") && {
            let condition = attribute.meta.to_token_stream().to_string();
            condition.contains("test") && !condition.contains("not")
        }
    })
}

/// The file that defines the item at a full path.
fn defining_file(path: &[String], modules: &BTreeSet<Module>, reexports: &Reexports, depth: usize) -> Module {
    let length =
        (0..=path.len()).rev().find(|&length| modules.contains(&path[..length])).expect("the root is a module");
    let (module, rest) = path.split_at(length);
    match rest.first().and_then(|name| reexports[module].get(name)) {
        Some(target) if depth < 16 => {
            let target: Vec<String> = target.iter().chain(&rest[1..]).cloned().collect();
            defining_file(&target, modules, reexports, depth + 1)
        }
        _ => module.to_vec(),
    }
}

/// The paths into its own crate that one file names.
struct Paths<'a> {
    modules: &'a BTreeSet<Module>,
    module: &'a Module,
    named: Vec<Vec<String>>,
    reexported: BTreeMap<String, Vec<String>>,
}

impl Paths<'_> {
    /// Reads items that stand in `scope`: the file's module or a module written inside the file.
    fn read(&mut self, items: &[Item], scope: &Module) {
        for item in items {
            match item {
                Item::Use(import) if !is_test(&import.attrs) => {
                    let is_reexport = !matches!(import.vis, Visibility::Inherited) && scope == self.module;
                    self.read_import(&import.tree, Vec::new(), scope, is_reexport);
                }
                Item::Mod(inner) if is_test(&inner.attrs) => {}
                Item::Mod(inner) => {
                    if let Some((_, items)) = &inner.content {
                        self.read(items, &child(scope, &inner.ident.to_string()));
                    }
                }
                Item::Fn(function) if is_test(&function.attrs) => {}
                Item::Impl(methods) if is_test(&methods.attrs) => {}
                other => self.read_tokens(other.to_token_stream(), scope),
            }
        }
    }

    fn read_import(&mut self, tree: &UseTree, mut path: Vec<String>, scope: &Module, is_reexport: bool) {
        let (name, last) = match tree {
            UseTree::Path(step) => {
                path.push(step.ident.to_string());
                return self.read_import(&step.tree, path, scope, is_reexport);
            }
            UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.read_import(tree, path.clone(), scope, is_reexport));
            }
            UseTree::Name(leaf) => (leaf.ident.to_string(), leaf.ident.to_string()),
            UseTree::Rename(leaf) => (leaf.rename.to_string(), leaf.ident.to_string()),
            UseTree::Glob(_) => (String::new(), String::new()),
        };
        if last != "self" && !last.is_empty() {
            path.push(last);
        }
        let Some(full) = self.absolute(&path, scope) else { return };
        match is_reexport && !name.is_empty() {
            true => drop(self.reexported.insert(name, full)),
            false => self.named.push(full),
        }
    }

    /// Reads paths in expressions and types, inside macros too.
    fn read_tokens(&mut self, tokens: TokenStream, scope: &Module) {
        let mut path: Vec<String> = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Punct(punct) if punct.as_char() == ':' => colons += 1,
                TokenTree::Ident(ident) if colons == 2 && !path.is_empty() => {
                    path.push(ident.to_string());
                    colons = 0;
                }
                TokenTree::Ident(ident) => {
                    self.end_path(&mut path, scope);
                    path.push(ident.to_string());
                    colons = 0;
                }
                other => {
                    self.end_path(&mut path, scope);
                    colons = 0;
                    if let TokenTree::Group(group) = other {
                        self.read_tokens(group.stream(), scope);
                    }
                }
            }
        }
        self.end_path(&mut path, scope);
    }

    fn end_path(&mut self, path: &mut Vec<String>, scope: &Module) {
        if path.len() > 1
            && let Some(full) = self.absolute(path, scope)
        {
            self.named.push(full);
        }
        path.clear();
    }

    /// The path from the crate's root; `None` for paths into other crates and for local names.
    fn absolute(&self, path: &[String], scope: &Module) -> Option<Vec<String>> {
        let first = path.first()?;
        match first.as_str() {
            "crate" => Some(path[1..].to_vec()),
            "self" => Some(scope.iter().chain(&path[1..]).cloned().collect()),
            "super" => {
                let ups = path.iter().take_while(|part| *part == "super").count();
                let kept = scope.len().checked_sub(ups)?;
                Some(scope[..kept].iter().chain(&path[ups..]).cloned().collect())
            }
            name if self.modules.contains(&child(scope, name)) => Some(scope.iter().chain(path).cloned().collect()),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rings_of(files: &[(&str, &str)]) -> Vec<String> {
        let module = |name: &str| name.split("::").filter(|part| !part.is_empty()).map(str::to_owned).collect();
        let files =
            files.iter().map(|(name, text)| (module(name), syn::parse_file(text).expect("Rust").items)).collect();
        rings(&graph_of(&files))
            .iter()
            .map(|ring| ring.iter().map(|m| m.join("::")).collect::<Vec<_>>().join(" "))
            .collect()
    }

    #[test]
    fn a_ring_is_found_through_uses_paths_macros_and_reexports() {
        let none: [String; 0] = [];
        let lib = ("", "mod a; mod b; pub use a::A; pub use b::B;");
        assert_eq!(rings_of(&[lib, ("a", "use crate::b::B; struct A;"), ("b", "struct B;")]), none);
        assert_eq!(rings_of(&[lib, ("a", "use crate::b::B; struct A;"), ("b", "use super::a::A; struct B;")]), ["a b"]);
        assert_eq!(rings_of(&[lib, ("a", "use crate::B;"), ("b", "use crate::A;")]), ["a b"]);
        assert_eq!(rings_of(&[lib, ("a", "fn f() { x!(crate::b::g()) }"), ("b", "fn g(a: &crate::A) {}")]), ["a b"]);
        let parent = ("a", "mod c; use c::C; pub struct A;");
        assert_eq!(rings_of(&[lib, parent, ("a::c", "use super::A; pub struct C;")]), ["a a::c"]);
        assert_eq!(rings_of(&[lib, parent, ("a::c", "pub struct C;")]), none);
    }

    #[test]
    fn tests_may_import_what_they_like() {
        let none: [String; 0] = [];
        let lib = ("", "mod a; mod b;");
        let tested = "struct B; #[cfg(test)] mod tests { use crate::a::A; }";
        assert_eq!(rings_of(&[lib, ("a", "use crate::b::B; struct A;"), ("b", tested)]), none);
        let in_file = [lib, ("a", "#[cfg(test)] mod tests; struct A;"), ("a::tests", "use super::A; use crate::b::B;")];
        assert_eq!(rings_of(&[in_file[0], in_file[1], in_file[2], ("b", "use crate::a::A; struct B;")]), none);
    }
}
