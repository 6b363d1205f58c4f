output "store" {
  description = "Value of --store and --coordinator."
  value       = "s3://${aws_s3_bucket.this.id}/${var.prefix}"
}

output "roles" {
  description = "The roles, by kind of process: annotate the service accounts with them (eks.amazonaws.com/role-arn)."
  value       = { for kind, role in aws_iam_role.this : kind => role.arn }
}
